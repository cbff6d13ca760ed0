//! Puts the wire between a host and the switch while both are in use.
//!
//! Before: `eth0` of the host, its other end `p1` a port of the bridge. After: `p1` is one end of the wire, `q1`
//! the other, and the other end of `q1`, `w1`, is the port.

use std::fs::File;

use super::error::Error;
use super::packet::{PacketSocket, Place};
use super::shell::{Rights, Shell};
use super::wire::{Ends, Wire};

/// Joins the host with this index, whose namespaces `holder` holds, to the switch by the wire.
pub(super) fn splice(
    shell: &mut Shell,
    wire: &Wire,
    index: usize,
    holder: u32,
) -> Result<(), Error> {
    let port = index + 1;
    let indexes = shell.run(&format!(
        "ip link add q{port} type veth peer name w{port}\n\
         ip link set q{port} up\n\
         ip link set w{port} up\n\
         ip -o link show p{port}\n\
         ip -o link show q{port}"
    ))?;
    let mut indexes = indexes.lines().filter_map(index_of);
    let (Some(p), Some(q)) = (indexes.next(), indexes.next()) else {
        return Err(Error::step("find the wire's devices", "ip shows none"));
    };
    let lab = format!("/proc/{}", shell.init_pid());
    let switch = format!("{lab}/ns/net");
    let ends = Ends {
        host: open(shell, &switch)?,
        switch: open(shell, &switch)?,
    };
    // The holder's id means something only in the lab's own /proc.
    let inside = open(shell, &format!("{lab}/root/proc/{holder}/ns/net"))?;
    let off = |socket: &PacketSocket, device: &str| {
        let refused = Error::io(format!("turn offload of {device} off"));
        socket.turn_offload_off(device).map_err(refused)
    };
    off(&inside, "eth0")?;
    for device in ["p", "q", "w"] {
        off(&ends.host, &format!("{device}{port}"))?;
    }
    let refused = || Error::io("bind the wire to its devices");
    ends.host.bind(p).map_err(refused())?;
    ends.switch.bind(q).map_err(refused())?;
    let known = shell.run(&format!(
        "bridge mdb show dev br0\nbridge fdb show brport p{port}"
    ))?;
    wire.join(index, ends);
    let mut script = format!("ip link set p{port} nomaster\nip link set w{port} master br0\n");
    for entry in moved(&known, port) {
        // Knowledge that the bridge would gain again by itself, but only in a second.
        script.push_str(&format!("bridge {entry} || true\n"));
    }
    shell.run(&script)?;
    Ok(())
}

/// Tells whether the kernel could emulate links by itself.
pub(super) fn has_netem(shell: &mut Shell) -> bool {
    shell
        .run("tc qdisc add dev lo root netem delay 1ms >/dev/null\ntc qdisc del dev lo root")
        .is_ok()
}

pub(super) fn open(shell: &Shell, net: &str) -> Result<PacketSocket, Error> {
    let file = |path: &str| File::open(path).map_err(Error::io(format!("open {path}")));
    let user = match shell.rights() {
        Rights::Root => None,
        Rights::UserNamespace => Some(file(&format!("/proc/{}/ns/user", shell.init_pid()))?),
    };
    let place = Place {
        user,
        net: file(net)?,
    };
    PacketSocket::open(&place).map_err(Error::io(format!("open a packet socket in {net}")))
}

/// Reads `3: p1@if2: <BROADCAST…`.
fn index_of(line: &str) -> Option<u32> {
    line.split_once(':')?.0.parse().ok()
}

/// Returns the `bridge` commands that give port `w1` what the bridge had learned of port `p1`.
fn moved(known: &str, port: usize) -> Vec<String> {
    let (old, new) = (format!("p{port}"), format!("w{port}"));
    let mut commands = Vec::new();
    for line in known.lines() {
        let command = match line.split_whitespace().collect::<Vec<_>>().as_slice() {
            ["dev", "br0", "port", of, "grp", group, ..] if *of == old => {
                format!("mdb add dev br0 port {new} grp {group} temp")
            }
            [address, "master", "br0"] => {
                format!("fdb replace {address} dev {new} master dynamic")
            }
            _ => continue,
        };
        if !commands.contains(&command) {
            commands.push(command);
        }
    }
    commands
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_bridge_learned_moves_and_what_is_its_own_stays() {
        let known = "dev br0 port p1 grp 239.77.0.1 temp\ndev br0 port p12 grp 239.77.0.2 temp\n\
                     dev br0 port p1 grp 239.77.0.1 src 10.0.0.1 temp\n\
                     0a:80:bc:b8:2a:90 master br0 \n6a:c7:01:d2:3e:0b master br0 permanent\n\
                     33:33:00:00:00:01 self permanent\n";

        assert_eq!(
            moved(known, 1),
            [
                "mdb add dev br0 port w1 grp 239.77.0.1 temp",
                "fdb replace 0a:80:bc:b8:2a:90 dev w1 master dynamic"
            ]
        );
        assert_eq!(index_of("13: p1@if2: <UP>"), Some(13));
    }
}
