//! Tells when this host's interfaces or their addresses may have changed.
//!
//! The kernel says so over netlink. What it says is not read: any message means to look again.

use std::io;
use std::os::fd::OwnedFd;
use std::time::Duration;

use rustix::io::Errno;
use rustix::net::netlink::SocketAddrNetlink;
use rustix::net::{AddressFamily, RecvFlags, SocketFlags, SocketType, bind, recv, socket_with};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::time::{Instant, sleep_until};

/// Multicast groups of `NETLINK_ROUTE`, by their bits: links, and IPv4 addresses.
const RTMGRP_LINK: u32 = 0x1;
const RTMGRP_IPV4_IFADDR: u32 = 0x10;
/// One change comes as several messages.
const TOGETHER: Duration = Duration::from_millis(20);
/// Where the kernel does not tell.
const POLL_PERIOD: Duration = Duration::from_secs(2);
/// Messages are cut to it: they only count.
const BUFFER_BYTES: usize = 256;

/// Waits for changes of interfaces.
pub(crate) struct Watch {
    news: Option<AsyncFd<OwnedFd>>,
    due: Option<Instant>,
    period: Duration,
}

impl Watch {
    /// Listens to the kernel, or else looks every two seconds, and says so.
    pub(crate) fn start() -> Self {
        let news = listen().and_then(register);
        match news {
            Ok(news) => Self {
                news: Some(news),
                ..Self::polling(POLL_PERIOD)
            },
            Err(error) => {
                tracing::warn!(%error, "no news of interfaces from the kernel: looking every two seconds");
                Self::polling(POLL_PERIOD)
            }
        }
    }

    fn polling(period: Duration) -> Self {
        Self {
            news: None,
            due: None,
            period,
        }
    }

    /// Completes when it is time to look. May be dropped at any time and called again.
    pub(crate) async fn changed(&mut self) {
        if let Some(news) = &self.news
            && self.due.is_none()
        {
            if let Err(error) = heard(news).await {
                tracing::warn!(%error, "news of interfaces ended: looking every two seconds");
                self.news = None;
            } else {
                self.due = Some(Instant::now() + TOGETHER);
            }
        }
        let due = *self.due.get_or_insert_with(|| Instant::now() + self.period);
        sleep_until(due).await;
        // What came in between is part of what will be seen now.
        self.due = None;
    }
}

fn listen() -> io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let fd = socket_with(AddressFamily::NETLINK, SocketType::RAW, flags, None)?;
    let groups = RTMGRP_LINK | RTMGRP_IPV4_IFADDR;
    bind(&fd, &SocketAddrNetlink::new(0, groups))?;
    Ok(fd)
}

#[expect(
    deprecated,
    reason = "its successor is unsafe, for files that are closed or replaced meanwhile; nothing does that to this one"
)]
fn register(fd: OwnedFd) -> io::Result<AsyncFd<OwnedFd>> {
    AsyncFd::with_interest(fd, Interest::READABLE)
}

/// Completes once something was said, and takes all of it.
async fn heard(news: &AsyncFd<OwnedFd>) -> io::Result<()> {
    loop {
        let mut ready = news.readable().await?;
        let mut buffer = [0; BUFFER_BYTES];
        let mut said = false;
        loop {
            match recv(news, &mut buffer, RecvFlags::empty()) {
                // Too much was said to be kept: that, too, is news.
                Ok(_) | Err(Errno::NOBUFS) => said = true,
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => break,
                Err(error) => return Err(error.into()),
            }
        }
        ready.clear_ready();
        if said {
            return Ok(());
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::time::timeout;

    use super::*;

    #[tokio::test]
    async fn without_the_kernel_time_goes_on_although_nobody_waits_for_long() {
        let mut watch = Watch::polling(Duration::from_millis(50));
        let start = Instant::now();
        let mut dropped = 0;

        while timeout(Duration::from_millis(1), watch.changed())
            .await
            .is_err()
        {
            dropped += 1;
            assert!(start.elapsed() < PATIENCE, "it begins anew each time");
        }

        assert!(dropped > 0 && start.elapsed() >= Duration::from_millis(50));
    }

    const PATIENCE: Duration = Duration::from_secs(10);
}
