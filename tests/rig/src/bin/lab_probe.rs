//! The smallest programs that show what a lab does: they send, answer, join a group, or hold a lab until they
//! are killed.

#![expect(
    clippy::print_stdout,
    reason = "what a probe says on its standard output is what its test reads"
)]

use std::error::Error;
use std::io::{self, Read};
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::process::Command;
use std::thread;
use std::time::Duration;

use ddx_rig::lab::Lab;

const USAGE: &str = "usage: lab_probe echo PORT | ping ADDRESS COUNT | send ADDRESS COUNT | join GROUP PORT \
                     | hold HOST...";

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
