//! ddx: an item for each size, so that a size that is refused takes no other along.

use std::any::Any;
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use ddx_store::{RawReader, RawWriter, ReaderOptions, Schema, Store, WriterOptions};

use crate::PUBLISHER;
use crate::program::{Contender, Options, Publisher, Sink};

pub(crate) struct Ddx;

struct Writers(Vec<(usize, Vec<RawWriter>)>);

impl Contender for Ddx {
    fn publisher(&self, options: &Options) -> Result<Box<dyn Publisher>> {
        refuse_reliable(options)?;
        let store = store()?;
        let mut all = Vec::new();
        for &size in &options.sizes {
            let mut writers = Vec::new();
            for item in 0..options.items {
                let layout = WriterOptions {
                    capacity_bytes: Some(u32::try_from(size)?),
                    ..WriterOptions::default()
                };
                writers.push(store.raw_writer(&name(size, item), &Schema::bytes(), layout)?);
            }
            all.push((size, writers));
        }
        Ok(Box::new(Writers(all)))
    }

    fn subscribe(&self, options: &Options, sink: Sink) -> Result<Box<dyn Any>> {
        refuse_reliable(options)?;
        let store = store()?;
        for &size in &options.sizes {
            for item in 0..options.items {
                let name = format!("{PUBLISHER}/{}", name(size, item));
                let reader =
                    store.raw_reader(&name, Some(&Schema::bytes()), ReaderOptions::default())?;
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

fn refuse_reliable(options: &Options) -> Result<()> {
    if options.reliable {
        bail!("ddx does not deliver every sample yet");
    }
    Ok(())
}

const PATIENCE: Duration = Duration::from_secs(10);
