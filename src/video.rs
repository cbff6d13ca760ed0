//! Streams of video in the store: their frames, what is known of their source, and a counter that travels where pictures do
//! not.

pub(crate) mod camera;
pub(crate) mod play;
pub(crate) mod recorder;
pub(crate) mod terminal;
pub(crate) mod v4l2;

use anyhow::Context as _;
use ddx_store::{
    Delivery, Error, Item, RawGuard, RawReader, RawWriter, ReaderOptions, Schema, Store, Writer,
    WriterOptions,
};
use ddx_video::frame::{Frame, FrameInfo, Layout};
use ddx_wire::{ItemName, Time};
use serde_json::{Value, json};

use crate::error::Failure;

/// `NAME/counter`: small enough to be logged beside other data, so that these can be lined up with the pictures.
#[derive(Clone, Copy, Debug, Item, PartialEq)]
#[repr(C)]
pub(crate) struct Counter {
    /// Number of the newest frame at its source.
    pub(crate) sequence: u64,
    /// Samples of the frame item, which are numbered anew when the source is started anew.
    pub(crate) samples: u64,
    /// When it was captured, as its source tells.
    #[ddx(unit = "ns")]
    pub(crate) capture: u64,
    /// Frames that the source has dropped.
    pub(crate) dropped: u64,
}

/// Writes the three items of a stream.
#[derive(Debug)]
pub(crate) struct StreamWriter {
    frames: RawWriter,
    counter: Writer<Counter>,
    info: RawWriter,
    layout: Layout,
    samples: u64,
}

/// Reads the frames of a stream in place.
#[derive(Debug)]
pub(crate) struct StreamReader {
    frames: RawReader,
}

/// What the samples of a frame item are.
pub(crate) fn schema() -> Result<Schema, Error> {
    Ok(Schema::raw(
        SCHEMA,
        "ddx",
        "frame, version 1: video/src/frame.rs",
    )?)
}

impl StreamWriter {
    /// Takes the leases of `NAME`, `NAME/info` and `NAME/counter`. `source` says to people where the frames come from.
    pub(crate) fn open(
        store: &Store,
        name: &str,
        layout: Layout,
        source: &str,
    ) -> Result<Self, Failure> {
        let name = frame_name(store, name)?;
        let capacity = u32::try_from(layout.size_bytes()).unwrap_or(u32::MAX);
        let options = WriterOptions {
            depth: DEPTH,
            pins: PINS,
            max_readers: READERS,
            capacity_bytes: Some(capacity),
        };
        let frames = store.raw_writer(name.as_str(), &schema()?, options)?;
        let counter = store.writer(&format!("{name}/counter"))?;
        let info = store.raw_writer(
            &format!("{name}/info"),
            &Schema::json(),
            WriterOptions::default(),
        )?;
        let mut stream = Self {
            frames,
            counter,
            info,
            layout,
            samples: 0,
        };
        stream.tell(source, &json!({}), 1)?;
        Ok(stream)
    }

    /// Writes `NAME/info`: the source, the fields, and parameters that hold from a frame on.
    pub(crate) fn tell(
        &mut self,
        source: &str,
        parameters: &Value,
        from: u64,
    ) -> Result<(), Failure> {
        let fields = self.layout.fields().iter().map(|field| {
            let spec = field.spec();
            json!({
                "name": spec.name,
                "format": spec.format.name(),
                "native": spec.native.name(),
                "width": spec.width,
                "height": spec.height,
                "range": format!("{:?}", spec.colour.range),
                "matrix": format!("{:?}", spec.colour.matrix),
                "siting": format!("{:?}", spec.colour.siting),
                "scan": format!("{:?}", spec.scan),
            })
        });
        let info = json!({
            "source": source,
            "fields": fields.collect::<Value>(),
            "parameters": parameters,
            "from_frame": from,
        });
        self.info.write(info.to_string().as_bytes())?;
        Ok(())
    }

    /// The layout of its frames.
    pub(crate) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Publishes a frame that `fill` writes in place, header included, for which it returns what it wrote there and when the
    /// frame was captured on this host. Nothing is published when it returns `None`.
    pub(crate) fn publish(
        &mut self,
        dropped: u64,
        fill: impl FnOnce(&Layout, &mut [u8]) -> Result<Option<(FrameInfo, Time)>, Failure>,
    ) -> Result<Option<FrameInfo>, Failure> {
        let mut loan = self.frames.loan(self.layout.size_bytes())?;
        let Some((info, capture)) = fill(&self.layout, loan.as_mut_slice())? else {
            return Ok(None);
        };
        loan.publish_at(capture)?;
        self.samples += 1;
        self.counter.write(&Counter {
            sequence: info.sequence,
            samples: self.samples,
            capture: info.capture_ns,
            dropped,
        })?;
        Ok(Some(info))
    }

    /// Readers of the frames on this host, of which one may stand for all of another host.
    pub(crate) fn readers(&self) -> u32 {
        self.frames.readers()
    }

    /// Whether each of them has read the newest frame; one that was there before this writer is not waited for.
    pub(crate) fn is_consumed(&self) -> bool {
        self.samples == 0 || self.frames.is_consumed()
    }
}

impl StreamReader {
    /// Opens a reader of the frames of `name`, of the newest or of each, and of at most so many a second of another host.
    pub(crate) fn open(
        store: &Store,
        name: &str,
        delivery: Delivery,
        rate: Option<f64>,
    ) -> Result<Self, Failure> {
        let options = ReaderOptions {
            delivery,
            rate,
            pins: 2,
            ..ReaderOptions::default()
        };
        let name = frame_name(store, name)?;
        Ok(Self {
            frames: store.raw_reader(name.as_str(), Some(&schema()?), options)?,
        })
    }

    /// The item's name.
    pub(crate) fn name(&self) -> &ItemName {
        self.frames.name()
    }

    /// The reader itself.
    pub(crate) fn frames(&mut self) -> &mut RawReader {
        &mut self.frames
    }
}

/// Whether the samples of an item are frames.
pub(crate) fn is_stream(other: &Schema) -> bool {
    // Made only for those that may be it: this is asked of each sample of each item that is watched.
    other.name() == SCHEMA && schema().is_ok_and(|schema| schema == *other)
}

/// What a frame says of itself, in place of its planes.
pub(crate) fn summary(payload: &[u8]) -> Value {
    match Frame::parse(payload) {
        Ok(frame) => json!({
            "frame": frame.info().sequence,
            "capture_ns": frame.info().capture_ns,
            "clock": format!("{:?}", frame.info().clock),
            "fields": frame.fields().map(|field| field.info.to_string()).collect::<Vec<_>>(),
        }),
        Err(fault) => json!({ "undecodable": fault.to_string() }),
    }
}

/// Checks what a sample holds.
pub(crate) fn frame(guard: &RawGuard) -> anyhow::Result<Frame<'_>> {
    Frame::parse(guard.bytes()).context("a sample of a video item")
}

fn frame_name(store: &Store, name: &str) -> Result<ItemName, Failure> {
    let text = match name.contains('/') {
        true => name.to_owned(),
        false => format!("./{name}"),
    };
    let name = ItemName::parse(&text, store.host())?;
    ddx_video::check_item_name(&name)?;
    Ok(name)
}

/// The name of the schema of frames.
const SCHEMA: &str = "frame";
/// Frames that the ring of a stream holds: a third of a second at 25 a second.
const DEPTH: u32 = 8;
/// Frames that readers may hold beyond the two that each has, together.
const PINS: u32 = 16;
const READERS: u32 = 16;
