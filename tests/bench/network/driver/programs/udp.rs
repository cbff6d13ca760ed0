//! Bare UDP with GSO and GRO: what no design can beat that sends datagrams. No repair, nothing sealed, fragments put together.

use std::any::Any;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::thread;

use anyhow::{Context, Result};
use quinn_udp::{RecvMeta, Transmit, UdpSockRef, UdpSocketState};
use rustix::event::{PollFd, PollFlags, poll};
use socket2::{Domain, Socket, Type};

use crate::program::{Contender, Options, Publisher, SOCKET_BUFFER_BYTES, Sink};

pub(crate) struct Udp;

struct Sender {
    socket: UdpSocket,
    state: UdpSocketState,
    to: SocketAddr,
    sample: Vec<u8>,
    /// Fragments of one sample, each with its header.
    fragments: Vec<u8>,
    next: u64,
}

/// The sample that fragments are put together to: one at a time, and a newer one ends it.
#[derive(Default)]
struct Assembly {
    id: u64,
    bytes: Vec<u8>,
    has: Vec<bool>,
    missing: usize,
}

impl Contender for Udp {
    fn publisher(&self, options: &Options) -> Result<Box<dyn Publisher>> {
        let socket = socket(0)?;
        let to = match options.subscribers.as_slice() {
            [one] => *one,
            _ => {
                socket.set_multicast_if_v4(&options.own)?;
                GROUP
            }
        };
        let socket = UdpSocket::from(socket);
        let state = UdpSocketState::new(UdpSockRef::from(&socket))?;
        Ok(Box::new(Sender {
            socket,
            state,
            to: (to, PORT).into(),
            sample: Vec::new(),
            fragments: Vec::new(),
            next: 0,
        }))
    }

    fn subscribe(&self, options: &Options, sink: Sink) -> Result<Box<dyn Any>> {
        let socket = socket(PORT)?;
        if options.subscribers.len() > 1 {
            socket.join_multicast_v4(&GROUP, &options.own)?;
        }
        let socket = UdpSocket::from(socket);
        let state = UdpSocketState::new(UdpSockRef::from(&socket))?;
        if options.items > 0 {
            thread::spawn(move || match receive(&socket, &state, &sink) {
                Ok(()) => {}
                Err(error) => eprintln!("error: {error:#}"),
            });
        }
        Ok(Box::new(()))
    }
}

impl Publisher for Sender {
    fn publish(&mut self, _item: usize, size: usize, fill: &dyn Fn(&mut [u8])) -> Result<()> {
        self.sample.resize(size, 0);
        fill(&mut self.sample);
        self.fragments.clear();
        for (index, chunk) in self.sample.chunks(CHUNK).enumerate() {
            self.fragments.extend(self.next.to_le_bytes());
            self.fragments.extend(u32::try_from(index)?.to_le_bytes());
            self.fragments.extend(u32::try_from(size)?.to_le_bytes());
            self.fragments.extend(chunk);
        }
        self.next += 1;
        let batch = self.state.max_gso_segments().clamp(1, SEGMENTS) * SEGMENT;
        for contents in self.fragments.chunks(batch) {
            let transmit = Transmit {
                destination: self.to,
                ecn: None,
                contents,
                segment_size: (contents.len() > SEGMENT).then_some(SEGMENT),
                src_ip: None,
            };
            // A full queue waits for room, as a blocking socket would; what the kernel refuses otherwise is lost.
            while let Err(error) = self
                .state
                .try_send(UdpSockRef::from(&self.socket), &transmit)
            {
                if error.kind() != std::io::ErrorKind::WouldBlock {
                    break;
                }
                wait(&self.socket, PollFlags::OUT)?;
            }
        }
        Ok(())
    }
}

fn receive(socket: &UdpSocket, state: &UdpSocketState, sink: &Sink) -> Result<()> {
    let mut buffers = vec![0; BATCH * BUFFER_BYTES];
    let mut metas = [RecvMeta::default(); BATCH];
    let mut assembly = Assembly::default();
    loop {
        let mut slices: Vec<_> = buffers
            .chunks_exact_mut(BUFFER_BYTES)
            .map(std::io::IoSliceMut::new)
            .collect();
        let filled = match state.recv(UdpSockRef::from(socket), &mut slices, &mut metas) {
            Ok(filled) => filled,
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {
                wait(socket, PollFlags::IN)?;
                continue;
            }
            Err(error) => return Err(error).context("receiving"),
        };
        for (meta, buffer) in metas
            .iter()
            .zip(buffers.chunks_exact(BUFFER_BYTES))
            .take(filled)
        {
            for datagram in buffer[..meta.len.min(BUFFER_BYTES)].chunks(meta.stride.max(1)) {
                if let Some(sample) = assembly.take(datagram) {
                    sink.take(sample);
                }
            }
        }
    }
}

impl Assembly {
    /// Adds a fragment, and returns the sample that it completes.
    fn take<'a>(&'a mut self, datagram: &'a [u8]) -> Option<&'a [u8]> {
        let (id, rest) = datagram.split_first_chunk()?;
        let (index, rest) = rest.split_first_chunk()?;
        let (size, chunk) = rest.split_first_chunk()?;
        let id = u64::from_le_bytes(*id);
        let index = usize::try_from(u32::from_le_bytes(*index)).ok()?;
        let size = usize::try_from(u32::from_le_bytes(*size)).ok()?;
        if chunk.len() == size {
            return Some(chunk);
        }
        if id != self.id || self.bytes.len() != size {
            self.id = id;
            self.bytes.resize(size, 0);
            self.missing = size.div_ceil(CHUNK);
            self.has.clear();
            self.has.resize(self.missing, false);
        }
        let had = self.has.get_mut(index)?;
        self.bytes
            .get_mut(index * CHUNK..index * CHUNK + chunk.len())?
            .copy_from_slice(chunk);
        if std::mem::replace(had, true) {
            return None;
        }
        self.missing -= 1;
        (self.missing == 0).then_some(&self.bytes)
    }
}

fn socket(port: u16) -> Result<Socket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, None)?;
    socket.set_recv_buffer_size(SOCKET_BUFFER_BYTES)?;
    socket.set_send_buffer_size(SOCKET_BUFFER_BYTES)?;
    let at: SocketAddr = (Ipv4Addr::UNSPECIFIED, port).into();
    socket.bind(&at.into()).context("binding")?;
    Ok(socket)
}

fn wait(socket: &UdpSocket, flags: PollFlags) -> Result<()> {
    poll(&mut [PollFd::new(socket, flags)], None).context("waiting")?;
    Ok(())
}

const PORT: u16 = 7003;
const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 77, 1);
/// Bytes of a datagram within an Ethernet frame, and of a sample in it.
const SEGMENT: usize = 1_472;
const CHUNK: usize = SEGMENT - 16;
/// Segments of the largest datagram run.
const SEGMENTS: usize = 44;
const BATCH: usize = 16;
const BUFFER_BYTES: usize = 65_536;

#[cfg(test)]
mod tests {
    use super::*;

    fn fragment(id: u64, index: u32, size: u32, chunk: &[u8]) -> Vec<u8> {
        let mut bytes = id.to_le_bytes().to_vec();
        bytes.extend(index.to_le_bytes());
        bytes.extend(size.to_le_bytes());
        bytes.extend(chunk);
        bytes
    }

    #[test]
    fn a_sample_is_complete_once_each_fragment_has_come() {
        let size = u32::try_from(CHUNK + 3).unwrap();
        let (first, second) = (vec![1; CHUNK], [2; 3]);
        let mut assembly = Assembly::default();

        assert_eq!(assembly.take(&fragment(1, 1, size, &second)), None);
        assert_eq!(assembly.take(&fragment(1, 1, size, &second)), None);
        let last = fragment(1, 0, size, &first);
        let sample = assembly.take(&last).unwrap();

        assert_eq!(sample, [first.as_slice(), &second].concat());
        assert_eq!(assembly.take(&fragment(2, 1, size, &second)), None);
    }
}
