//! The smallest programs that show what a lab does: they send, answer, join a group, or hold a lab until they
//! are killed.

#![expect(
    clippy::print_stdout,
    reason = "what a probe says on its standard output is what its test reads"
)]

use std::error::Error;
use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use ddx_rig::lab::Lab;
use ddx_rig::link::Profile;

const USAGE: &str = "usage: lab_probe echo PORT | ping ADDRESS COUNT | send ADDRESS COUNT | join GROUP PORT \
                     | train ADDRESS COUNT INTERVAL_US BYTES | trace PORT [GROUP] | sink PORT | pour ADDRESS BYTES | wire | hold HOST...";

fn main() -> Result<(), Box<dyn Error>> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    match words
        .iter()
        .map(String::as_str)
        .collect::<Vec<_>>()
        .as_slice()
    {
        ["echo", port] => echo(port.parse()?),
        ["ping", to, count] => ping(to.parse()?, count.parse()?),
        ["send", to, count] => send(to.parse()?, count.parse()?),
        ["join", group, port] => join(group.parse()?, port.parse()?),
        ["train", to, count, interval, bytes] => train(
            to.parse()?,
            count.parse()?,
            Duration::from_micros(interval.parse()?),
            bytes.parse()?,
        ),
        ["trace", port] => trace(port.parse()?, None),
        ["trace", port, group] => trace(port.parse()?, Some(group.parse()?)),
        ["sink", port] => sink(port.parse()?),
        ["pour", to, bytes] => pour(to.parse()?, bytes.parse()?),
        ["wire"] => wire(),
        ["hold", hosts @ ..] => hold(hosts),
        _ => Err(USAGE.into()),
    }
}

/// Answers each datagram with itself.
fn echo(port: u16) -> Result<(), Box<dyn Error>> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port))?;
    println!("ready");
    let mut buffer = [0; 1500];
    loop {
        let (length, from) = socket.recv_from(&mut buffer)?;
        socket.send_to(&buffer[..length], from)?;
    }
}

/// Sends datagrams one by one, each after the answer to the one before or a tenth of a second, and tells how
/// many were answered.
fn ping(to: SocketAddrV4, count: u32) -> Result<(), Box<dyn Error>> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    socket.set_read_timeout(Some(Duration::from_millis(100)))?;
    let mut answered = 0;
    for number in 0..count {
        socket.send_to(&number.to_le_bytes(), to)?;
        let mut answer = [0; 4];
        answered += u32::from(socket.recv(&mut answer).is_ok() && answer == number.to_le_bytes());
    }
    println!("answered {answered}");
    Ok(())
}

/// Sends datagrams of 100 bytes, with a pause now and then so that no queue on the way overflows.
fn send(to: SocketAddrV4, count: u32) -> Result<(), Box<dyn Error>> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    for number in 0..count {
        socket.send_to(&[0; 100], to)?;
        if number % 32 == 31 {
            thread::sleep(Duration::from_millis(1));
        }
    }
    println!("sent {count}");
    Ok(())
}

/// Is a member of a group until its input ends, then tells how many datagrams came.
fn join(group: Ipv4Addr, port: u16) -> Result<(), Box<dyn Error>> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port))?;
    socket.join_multicast_v4(&group, &Ipv4Addr::UNSPECIFIED)?;
    println!("joined");
    io::stdin().read_to_end(&mut Vec::new())?;
    socket.set_nonblocking(true)?;
    let mut buffer = [0; 1500];
    let mut received = 0;
    while socket.recv(&mut buffer).is_ok() {
        received += 1;
    }
    println!("received {received}");
    Ok(())
}

/// Sends numbered and stamped datagrams of so many bytes of payload, one each interval; late, it catches up.
fn train(
    to: SocketAddrV4,
    count: u32,
    interval: Duration,
    bytes: usize,
) -> Result<(), Box<dyn Error>> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    let mut payload = vec![0; bytes.max(STAMP_BYTES)];
    let start = Instant::now();
    for number in 0..count {
        let due = interval * number;
        thread::sleep(due.saturating_sub(start.elapsed()));
        payload[..4].copy_from_slice(&number.to_le_bytes());
        payload[4..STAMP_BYTES].copy_from_slice(&clock_ns()?.to_le_bytes());
        socket.send_to(&payload, to)?;
    }
    println!("sent {count} in {} us", start.elapsed().as_micros());
    Ok(())
}

/// Receives what [`train`] sends until its input ends, then tells of each datagram its number, how many
/// nanoseconds it was on the way, and when it came.
fn trace(port: u16, group: Option<Ipv4Addr>) -> Result<(), Box<dyn Error>> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port))?;
    rustix::net::sockopt::set_socket_recv_buffer_size(&socket, 4 << 20)?;
    if let Some(group) = group {
        socket.join_multicast_v4(&group, &Ipv4Addr::UNSPECIFIED)?;
    }
    // The end of the input is looked for only when nothing comes, so that all that is there is told.
    socket.set_read_timeout(Some(Duration::from_millis(20)))?;
    println!("ready");
    let input = thread::spawn(|| io::stdin().read_to_end(&mut Vec::new()));
    let mut seen = Vec::new();
    let mut payload = [0; 1500];
    loop {
        match socket.recv(&mut payload) {
            Ok(length) => {
                let now = clock_ns()?;
                let stamp = stamp(&payload[..length]);
                seen.extend(stamp.map(|(number, sent)| (number, now - sent, now)));
            }
            Err(_) if input.is_finished() => break,
            Err(_) => {}
        }
    }
    for (number, delay, at) in seen {
        println!("{number} {delay} {at}");
    }
    println!("end");
    Ok(())
}

/// Takes all bytes of one connection, and answers with how many there were.
fn sink(port: u16) -> Result<(), Box<dyn Error>> {
    let listener = TcpListener::bind((Ipv4Addr::UNSPECIFIED, port))?;
    println!("ready");
    let (mut stream, _) = listener.accept()?;
    let bytes = io::copy(&mut stream, &mut io::sink())?;
    stream.write_all(&bytes.to_le_bytes())?;
    Ok(())
}

/// Sends so many bytes by one connection and tells how long it took until all were there.
fn pour(to: SocketAddrV4, bytes: u64) -> Result<(), Box<dyn Error>> {
    let mut stream = TcpStream::connect(to)?;
    let start = Instant::now();
    io::copy(&mut io::repeat(7).take(bytes), &mut stream)?;
    stream.shutdown(std::net::Shutdown::Write)?;
    let mut answer = [0; 8];
    stream.read_exact(&mut answer)?;
    let arrived = u64::from_le_bytes(answer);
    println!("{arrived} in {} us", start.elapsed().as_micros());
    Ok(())
}

fn stamp(payload: &[u8]) -> Option<(u32, u64)> {
    let (number, rest) = payload.split_first_chunk()?;
    let sent = rest.first_chunk()?;
    Some((u32::from_le_bytes(*number), u64::from_le_bytes(*sent)))
}

/// The one clock of all hosts of a lab.
fn clock_ns() -> Result<u64, Box<dyn Error>> {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    let now = Duration::try_from(now)?;
    Ok(u64::try_from(now.as_nanos())?)
}

/// Builds a lab, makes one link slow, and tells how long a datagram and its answer take over it.
fn wire() -> Result<(), Box<dyn Error>> {
    let lab = Lab::new(&["a", "b"])?;
    let probe = std::env::current_exe()?;
    let echo = lab
        .host("b")
        .spawn(Command::new(&probe).args(["echo", "7000"]))?;
    echo.wait_line(|line| line == "ready", Duration::from_secs(10))?;
    lab.host("b")
        .set_link(&Profile::parse("lan --delay 20ms")?)?;
    let start = Instant::now();
    let mut ping = Command::new(&probe);
    ping.args(["ping", "10.77.0.2:7000", "20"]);
    let said = lab.host("a").exec(&ping)?.stdout;
    println!("rights {:?}", lab.rights());
    println!("{} in {} ms", said.trim(), start.elapsed().as_millis());
    Ok(())
}

/// Builds a lab with a program in each host, tells whose namespaces it is, and keeps it until its input ends.
fn hold(hosts: &[&str]) -> Result<(), Box<dyn Error>> {
    let lab = Lab::new(hosts)?;
    let mut programs = Vec::new();
    for host in lab.hosts() {
        programs.push(host.spawn(Command::new("sleep").arg("1000"))?);
        println!(
            "namespace {}",
            host.shell("readlink /proc/self/ns/net")?.trim()
        );
        println!(
            "namespace {}",
            host.shell("readlink /proc/self/ns/mnt")?.trim()
        );
    }
    println!(
        "namespace {}",
        lab.switch("readlink /proc/self/ns/net")?.trim()
    );
    println!("init {}", lab.init_pid());
    println!("rights {:?}", lab.rights());
    io::stdin().read_to_end(&mut Vec::new())?;
    Ok(())
}

/// Number and time of sending.
const STAMP_BYTES: usize = 12;
