//! One socket that carries samples in batches: GSO on the way out, GRO on the way in (`quinn-udp`).

use std::io::{self, IoSliceMut};
use std::net::{IpAddr, SocketAddr, UdpSocket};

use quinn_udp::{RecvMeta, Transmit, UdpSockRef, UdpSocketState};

use super::Outlets;

/// Buffers filled by one system call.
const RECEIVE_BATCH: usize = 16;
/// Largest run of datagrams that GRO joins.
const BUFFER_BYTES: usize = 65_536;

/// What one call took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Batch {
    pub(crate) datagrams: usize,
    /// Every buffer was filled, so that more may be waiting.
    pub(crate) full: bool,
}

/// A UDP socket with offloads, for one thread.
pub(crate) struct Channel {
    socket: UdpSocket,
    state: UdpSocketState,
    outlets: Outlets,
    buffers: Vec<u8>,
}

impl Channel {
    pub(crate) fn new(socket: UdpSocket) -> io::Result<Self> {
        let state = UdpSocketState::new(UdpSockRef::from(&socket))?;
        Ok(Self {
            socket,
            state,
            outlets: Outlets::default(),
            buffers: Vec::new(),
        })
    }

    /// The same, sending to groups by these interfaces.
    pub(crate) fn with_outlets(self, outlets: Outlets) -> Self {
        Self { outlets, ..self }
    }

    /// Sends one datagram, or a run of equal ones of `segment` bytes; to a group, by each of its interfaces. A full queue is
    /// the error `WouldBlock`.
    pub(crate) fn send(
        &self,
        to: SocketAddr,
        contents: &[u8],
        segment: Option<usize>,
    ) -> io::Result<()> {
        let send = |source: Option<IpAddr>| {
            let transmit = Transmit {
                destination: to,
                ecn: None,
                contents,
                segment_size: segment,
                // Of a multicast datagram this decides the interface, too.
                src_ip: source,
            };
            self.state
                .try_send(UdpSockRef::from(&self.socket), &transmit)
        };
        if !to.ip().is_multicast() {
            return send(None);
        }
        let sources = self.outlets.sources(to.ip());
        if sources.is_empty() {
            return send(None);
        }
        // One interface that fails does not keep the others from it.
        let mut sent = Ok(());
        for source in sources {
            sent = sent.and(send(Some(source.into())));
        }
        sent
    }

    /// Most datagrams in one run.
    pub(crate) fn max_segments(&self) -> usize {
        self.state.max_gso_segments()
    }

    /// Most datagrams that one receive may bring in one run.
    pub(crate) fn max_received_segments(&self) -> usize {
        self.state.gro_segments()
    }

    /// Takes what has arrived, without waiting, and hands over datagram after datagram.
    pub(crate) fn receive(
        &mut self,
        mut each: impl FnMut(SocketAddr, &mut [u8]),
    ) -> io::Result<Batch> {
        self.buffers.resize(BUFFER_BYTES * RECEIVE_BATCH, 0);
        let mut metas = [RecvMeta::default(); RECEIVE_BATCH];
        let mut chunks = self.buffers.chunks_exact_mut(BUFFER_BYTES);
        let filled = {
            let mut slices: [IoSliceMut<'_>; RECEIVE_BATCH] =
                std::array::from_fn(|_| IoSliceMut::new(chunks.next().unwrap_or_default()));
            match self
                .state
                .recv(UdpSockRef::from(&self.socket), &mut slices, &mut metas)
            {
                Ok(filled) => filled,
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => return Ok(Batch::default()),
                Err(e) => return Err(e),
            }
        };
        let mut datagrams = 0;
        for (meta, buffer) in metas
            .iter()
            .zip(self.buffers.chunks_exact_mut(BUFFER_BYTES))
            .take(filled)
        {
            let Some(run) = buffer.get_mut(..meta.len) else {
                continue;
            };
            for datagram in run.chunks_mut(meta.stride.max(1)) {
                each(meta.addr, datagram);
                datagrams += 1;
            }
        }
        Ok(Batch {
            datagrams,
            full: filled == RECEIVE_BATCH,
        })
    }
}
