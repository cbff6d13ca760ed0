//! zenoh as a contender of the network bench: peers that find one another by multicast, as is its default, and carry samples
//! over TCP, TLS or QUIC. A full queue makes the publisher wait, as in its own throughput example.

use std::any::Any;

use anyhow::{Result, anyhow};
use program::{Contender, Options, Publisher, SOCKET_BUFFER_BYTES, Sink};
use serde_json::{Value, json};
use zenoh::qos::CongestionControl;
use zenoh::{Config, Session, Wait};

#[path = "../../../driver/program.rs"]
#[allow(dead_code, reason = "the driver uses more of it")]
mod program;

struct Zenoh {
    is_quic: bool,
}

struct Publishers {
    publishers: Vec<zenoh::pubsub::Publisher<'static>>,
    sample: Vec<u8>,
    _session: Session,
}

fn main() -> Result<()> {
    let mut words = std::env::args().skip(1).peekable();
    let is_quic = words.next_if(|word| word == "quic").is_some();
    program::play(words, &Zenoh { is_quic })
}

impl Zenoh {
    fn open(&self, options: &Options) -> Result<Session> {
        let link = match (&options.tls, self.is_quic) {
            (None, _) => "tcp",
            (Some(_), false) => "tls",
            (Some(_), true) => "quic",
        };
        let mut config = Config::default();
        let mut set = |key: &str, value: Value| {
            config
                .insert_json5(key, &value.to_string())
                .map_err(|error| anyhow!("{key}: {error}"))
        };
        set(
            "listen/endpoints",
            json!([format!("{link}/{}:0", options.own)]),
        )?;
        set("transport/link/protocols", json!([link]))?;
        set("scouting/multicast/interface", json!("eth0"))?;
        match &options.tls {
            None => {
                set("transport/link/tcp/so_rcvbuf", json!(SOCKET_BUFFER_BYTES))?;
                set("transport/link/tcp/so_sndbuf", json!(SOCKET_BUFFER_BYTES))?;
            }
            Some(tls) => {
                let file = |name: &str| json!(tls.join(name));
                set("transport/link/tls/root_ca_certificate", file("ca.pem"))?;
                set("transport/link/tls/listen_certificate", file("cert.pem"))?;
                set("transport/link/tls/listen_private_key", file("key.pem"))?;
                set("transport/link/tls/connect_certificate", file("cert.pem"))?;
                set("transport/link/tls/connect_private_key", file("key.pem"))?;
                set("transport/link/tls/enable_mtls", json!(true))?;
            }
        }
        zenoh::open(config)
            .wait()
            .map_err(|error| anyhow!("opening: {error}"))
    }
}

impl Contender for Zenoh {
    fn publisher(&self, options: &Options) -> Result<Box<dyn Publisher>> {
        let session = self.open(options)?;
        let mut publishers = Vec::new();
        for item in 0..options.items {
            let publisher = session
                .declare_publisher(name(item))
                .congestion_control(CongestionControl::Block)
                .wait();
            publishers.push(publisher.map_err(|error| anyhow!("declaring: {error}"))?);
        }
        Ok(Box::new(Publishers {
            publishers,
            sample: Vec::new(),
            _session: session,
        }))
    }

    fn subscribe(&self, options: &Options, sink: Sink) -> Result<Box<dyn Any>> {
        let session = self.open(options)?;
        let mut subscribers = Vec::new();
        for item in 0..options.items {
            let sink = sink.clone();
            let subscriber = session
                .declare_subscriber(name(item))
                .callback(move |sample| sink.take(&sample.payload().to_bytes()))
                .wait();
            subscribers.push(subscriber.map_err(|error| anyhow!("declaring: {error}"))?);
        }
        Ok(Box::new((session, subscribers)))
    }
}

impl Publisher for Publishers {
    fn publish(&mut self, item: usize, size: usize, fill: &dyn Fn(&mut [u8])) -> Result<()> {
        self.sample.resize(size, 0);
        fill(&mut self.sample);
        let Some(publisher) = self.publishers.get(item) else {
            return Ok(());
        };
        // The copy is the library's: it keeps what it sends.
        publisher
            .put(self.sample.as_slice())
            .wait()
            .map_err(|error| anyhow!("{error}"))
    }
}

fn name(item: usize) -> String {
    format!("bench/{item}")
}
