//! ddx: an item for each size, so that a size that is refused takes no other along. Its ring, which is its only queue, holds
//! what the sockets of the peers do.

use std::any::Any;
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result};
use ddx_store::{Delivery, RawReader, RawWriter, ReaderOptions, Schema, Store, WriterOptions};

use crate::PUBLISHER;
use crate::program::{Contender, Options, Publisher, SOCKET_BUFFER_BYTES, Sink};

pub(crate) struct Ddx;

struct Writers(Vec<(usize, Vec<RawWriter>)>);

impl Contender for Ddx {
    fn publisher(&self, options: &Options) -> Result<Box<dyn Publisher>> {
        let store = store()?;
        let mut all = Vec::new();
        for &size in &options.sizes {
            let mut writers = Vec::new();
            for item in 0..options.items {
                let default = WriterOptions::default();
                let queue = u32::try_from(SOCKET_BUFFER_BYTES / size)?;
                let layout = WriterOptions {
                    capacity_bytes: Some(u32::try_from(size)?),
                    depth: queue.clamp(default.depth, DEPTH_MAX),
                    ..default
                };
                writers.push(store.raw_writer(&name(size, item), &Schema::bytes(), layout)?);
            }
            all.push((size, writers));
        }
        Ok(Box::new(Writers(all)))
    }

    fn subscribe(&self, options: &Options, sink: Sink) -> Result<Box<dyn Any>> {
        let store = store()?;
        for &size in &options.sizes {
            for item in 0..options.items {
                let name = format!("{PUBLISHER}/{}", name(size, item));
                let how = ReaderOptions {
                    delivery: match options.reliable {
                        true => Delivery::Every,
                        false => Delivery::Latest,
                    },
                    ..ReaderOptions::default()
                };
                let reader = store.raw_reader(&name, Some(&Schema::bytes()), how)?;
                let sink = sink.clone();
                thread::spawn(move || read(reader, &sink));
            }
        }
        Ok(Box::new(store))
    }
}

impl Publisher for Writers {
    fn publish(&mut self, item: usize, size: usize, fill: &dyn Fn(&mut [u8])) -> Result<()> {
        let writer = self
            .0
            .iter_mut()
            .find(|(of, _)| *of == size)
            .and_then(|(_, writers)| writers.get_mut(item))
            .context("no item of this size")?;
        let mut loan = writer.loan(size)?;
        fill(loan.as_mut_slice());
        loan.publish()?;
        Ok(())
    }
}

/// Hands over each sample, in place, until the process ends.
fn read(mut reader: RawReader, sink: &Sink) {
    loop {
        match reader.next_pinned(PATIENCE) {
            Ok(Some(sample)) => sink.take(sample.bytes()),
            Ok(None) => {}
            Err(error) => {
                eprintln!("error: {error}");
                return;
            }
        }
    }
}

fn store() -> Result<Store> {
    Store::options()
        .timeout(PATIENCE)
        .open()
        .context("opening the store")
}

/// A name of one chunk: below this host's prefix.
fn name(size: usize, item: usize) -> String {
    format!("bench-{size}-{item}")
}

/// Most samples that a ring holds.
const DEPTH_MAX: u32 = 16_384;
const PATIENCE: Duration = Duration::from_secs(10);
