//! Packet sockets in the namespaces of a lab, and what only a system call without a safe face can do with them.
//!
//! A process with threads, as a test is, cannot enter a user namespace, and without that a plain user may not
//! enter the network namespace either. So a forked child enters both, opens a socket there and hands it back. A
//! socket stays in its namespace whoever holds it: the calls after that need no further entering.
//!
//! Invariant of the unsafe blocks: each passes the kernel a pointer to a value on the stack of the same function,
//! with that value's own size, and the kernel keeps none of them.

use std::ffi::c_char;
use std::fs::File;
use std::io::{self, IoSlice, IoSliceMut};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::ptr;

use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer,
    SendAncillaryMessage, SendFlags, SocketFlags, SocketType, recvmsg, sendmsg, socket_with,
    socketpair, sockopt,
};
use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

/// The namespaces in which a socket is opened.
#[derive(Debug)]
pub(super) struct Place {
    /// Entered first; `None` when the caller has its rights already.
    pub(super) user: Option<File>,
    pub(super) net: File,
}

/// A packet socket, which until it is bound receives nothing.
#[derive(Debug)]
pub(super) struct PacketSocket(OwnedFd);

impl PacketSocket {
    /// Opens one in other namespaces. Blocks for some milliseconds.
    pub(super) fn open(place: &Place) -> io::Result<Self> {
        let (ours, theirs) = socketpair(
            AddressFamily::UNIX,
            SocketType::DGRAM,
            SocketFlags::CLOEXEC,
            None,
        )?;
        let user = place.user.as_ref().map(File::try_clone).transpose()?;
        let net = place.net.try_clone()?;
        let mut child = Command::new("true");
        child.stdin(Stdio::null()).stdout(Stdio::null());
        let open = move || open_and_send(user.as_ref(), &net, theirs.as_fd());
        // SAFETY: between fork and exec only system calls are made, through rustix, which allocates nothing and
        // takes no lock; the closure owns all descriptors that it uses.
        unsafe { child.pre_exec(open) };
        child.status()?;
        receive(ours.as_fd()).map(Self)
    }

    /// Receives each frame that enters this device from now on, and sends to it.
    pub(super) fn bind(&self, device_index: u32) -> io::Result<()> {
        let device_index = i32::try_from(device_index).map_err(io::Error::other)?;
        let address = libc::sockaddr_ll {
            sll_family: PACKET_FAMILY,
            sll_protocol: EVERY_PROTOCOL.to_be(),
            sll_ifindex: device_index,
            sll_hatype: 0,
            sll_pkttype: 0,
            sll_halen: 0,
            sll_addr: [0; 8],
        };
        // SAFETY: the descriptor is open; the pointer and the length are those of `address`, a packet address.
        let status = unsafe {
            libc::bind(
                self.0.as_raw_fd(),
                (&raw const address).cast(),
                length_of(&address),
            )
        };
        checked(status)?;
        // As much as this user may have: the wire may be late by a few milliseconds.
        if sockopt::set_socket_recv_buffer_size_force(&self.0, BUFFER_BYTES).is_err() {
            sockopt::set_socket_recv_buffer_size(&self.0, BUFFER_BYTES)?;
        }
        Ok(())
    }

    /// Receives a frame, or nothing when none is there.
    pub(super) fn receive<'a>(&self, buffer: &'a mut [u8]) -> Option<&'a [u8]> {
        let (_, length) = rustix::net::recv(&self.0, &mut *buffer, RecvFlags::DONTWAIT).ok()?;
        buffer.get(..length)
    }

    /// Sends a frame; false when the kernel has no room for it.
    pub(super) fn send(&self, frame: &[u8]) -> bool {
        rustix::net::send(&self.0, frame, SendFlags::DONTWAIT).is_ok()
    }

    /// Turns off what a device leaves for later or joins together, so that a frame on it is as it is on a cable.
    ///
    /// The device is one of the namespace in which the socket was opened.
    pub(super) fn turn_offload_off(&self, device: &str) -> io::Result<()> {
        for command in OFFLOADS {
            self.set_to_zero(device, command)?;
        }
        Ok(())
    }

    /// Has the kernel cut runs of segments up before they enter the device, so that what passes it are packets as on a
    /// cable. Until then they stay whole, which is what makes TCP fast.
    ///
    /// The device is one of the namespace in which the socket was opened.
    pub(super) fn turn_segmentation_off(&self, device: &str) -> io::Result<()> {
        self.set_to_zero(device, SET_TCP_SEGMENTATION)?;
        let mut names = EthtoolStrings {
            command: GET_STRINGS,
            set: FEATURES,
            length: 0,
            names: [[0; 32]; FEATURES_MAX],
        };
        let mut counted = EthtoolSet {
            command: GET_SET_INFO,
            reserved: 0,
            mask: 1 << FEATURES,
            length: 0,
        };
        self.ethtool(device, &mut counted)?;
        if usize::try_from(counted.length).is_ok_and(|length| length > FEATURES_MAX) {
            return Err(io::Error::other("devices have more features than expected"));
        }
        self.ethtool(device, &mut names)?;
        let is_it = |name: &[u8; 32]| name.starts_with(UDP_SEGMENTATION);
        // A kernel without the feature cuts up by itself.
        let Some(place) = names.names.iter().position(is_it) else {
            return Ok(());
        };
        let words = counted.length.div_ceil(32);
        let mut change = EthtoolFeatures {
            command: SET_FEATURES,
            words,
            changes: [[0; 2]; FEATURES_MAX / 32],
        };
        change.changes[place / 32][0] = 1 << (place % 32);
        self.ethtool(device, &mut change)
    }

    fn set_to_zero(&self, device: &str, command: u32) -> io::Result<()> {
        self.ethtool(device, &mut EthtoolValue { command, data: 0 })
    }

    fn ethtool<C: EthtoolCommand>(&self, device: &str, command: &mut C) -> io::Result<()> {
        let mut name = [0; libc::IFNAMSIZ];
        for (to, from) in name[..libc::IFNAMSIZ - 1].iter_mut().zip(device.bytes()) {
            *to = c_char::from_ne_bytes([from]);
        }
        let mut request = libc::ifreq {
            ifr_name: name,
            ifr_ifru: libc::__c_anonymous_ifr_ifru {
                ifru_data: ptr::from_mut(command).cast(),
            },
        };
        // SAFETY: the descriptor is open; SIOCETHTOOL takes a `struct ifreq` whose data is what its command says, which
        // `EthtoolCommand` promises; both live until the call returns.
        let status = unsafe { libc::ioctl(self.0.as_raw_fd(), SIOCETHTOOL, &raw mut request) };
        checked(status)
    }

    /// Returns how many frames the kernel dropped because the buffer was full, since the last call.
    pub(super) fn overruns(&self) -> u64 {
        let mut seen = libc::tpacket_stats {
            tp_packets: 0,
            tp_drops: 0,
        };
        let mut length = length_of(&seen);
        // SAFETY: the descriptor is open; the option writes a `struct tpacket_stats`, and no more than `length`
        // bytes of it.
        let status = unsafe {
            libc::getsockopt(
                self.0.as_raw_fd(),
                libc::SOL_PACKET,
                libc::PACKET_STATISTICS,
                (&raw mut seen).cast(),
                &raw mut length,
            )
        };
        if status == 0 {
            u64::from(seen.tp_drops)
        } else {
            0
        }
    }
}

impl AsFd for PacketSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

/// What the child does.
fn open_and_send(user: Option<&File>, net: &File, to: BorrowedFd<'_>) -> io::Result<()> {
    if let Some(user) = user {
        move_into_link_name_space(user.as_fd(), Some(LinkNameSpaceType::User))?;
    }
    move_into_link_name_space(net.as_fd(), Some(LinkNameSpaceType::Network))?;
    let socket = socket_with(
        AddressFamily::PACKET,
        SocketType::RAW,
        SocketFlags::CLOEXEC,
        None,
    )?;
    let sockets = [socket.as_fd()];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut ancillary = SendAncillaryBuffer::new(&mut space);
    ancillary.push(SendAncillaryMessage::ScmRights(&sockets));
    sendmsg(
        to,
        &[IoSlice::new(b"s")],
        &mut ancillary,
        SendFlags::empty(),
    )?;
    Ok(())
}

fn receive(from: BorrowedFd<'_>) -> io::Result<OwnedFd> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut ancillary = RecvAncillaryBuffer::new(&mut space);
    let mut byte = [0];
    let flags = RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC;
    recvmsg(
        from,
        &mut [IoSliceMut::new(&mut byte)],
        &mut ancillary,
        flags,
    )?;
    for message in ancillary.drain() {
        if let RecvAncillaryMessage::ScmRights(mut sockets) = message
            && let Some(socket) = sockets.next()
        {
            return Ok(socket);
        }
    }
    Err(io::Error::other("the child sent no socket"))
}

fn checked(status: i32) -> io::Result<()> {
    if status == 0 {
        Ok(())
    } else {
        Err(io::Error::last_os_error())
    }
}

fn length_of<T>(_: &T) -> libc::socklen_t {
    libc::socklen_t::try_from(size_of::<T>()).unwrap_or(0)
}

/// A structure that begins with an ethtool command and has room for all that the kernel reads and writes for it.
trait EthtoolCommand {}

impl EthtoolCommand for EthtoolValue {}
impl EthtoolCommand for EthtoolSet {}
impl EthtoolCommand for EthtoolStrings {}
impl EthtoolCommand for EthtoolFeatures {}

/// `struct ethtool_value` of the kernel.
#[repr(C)]
struct EthtoolValue {
    command: u32,
    data: u32,
}

/// `struct ethtool_sset_info` for one set.
#[repr(C)]
struct EthtoolSet {
    command: u32,
    reserved: u32,
    mask: u64,
    length: u32,
}

/// `struct ethtool_gstrings`.
#[repr(C)]
struct EthtoolStrings {
    command: u32,
    set: u32,
    length: u32,
    names: [[u8; 32]; FEATURES_MAX],
}

/// `struct ethtool_sfeatures`: for each 32 features which to change, and to what.
#[repr(C)]
struct EthtoolFeatures {
    command: u32,
    words: u32,
    changes: [[u32; 2]; FEATURES_MAX / 32],
}

const SIOCETHTOOL: libc::Ioctl = 0x8946;

/// Receive and transmit checksums, scatter-gather, TSO, GSO, GRO: `ETHTOOL_S…` of the kernel.
const OFFLOADS: [u32; 6] = [0x15, 0x17, 0x19, 0x1f, 0x24, 0x2c];

/// `ETHTOOL_STSO`, which is one of those.
const SET_TCP_SEGMENTATION: u32 = 0x1f;
/// `ETHTOOL_GSTRINGS`, `ETHTOOL_GSSET_INFO`, `ETHTOOL_SFEATURES` and `ETH_SS_FEATURES` of the kernel.
const GET_STRINGS: u32 = 0x1b;
const GET_SET_INFO: u32 = 0x37;
const SET_FEATURES: u32 = 0x3b;
const FEATURES: u32 = 4;
/// Twice what kernels have; checked, since the kernel writes as many as it has.
const FEATURES_MAX: usize = 128;
const UDP_SEGMENTATION: &[u8] = b"tx-udp-segmentation\0";

/// `AF_PACKET`, as the address has it.
const PACKET_FAMILY: u16 = 17;

/// `ETH_P_ALL`.
const EVERY_PROTOCOL: u16 = 3;

/// Some two thousand frames, each of which the kernel books with twice its size or more.
const BUFFER_BYTES: usize = 8 << 20;
