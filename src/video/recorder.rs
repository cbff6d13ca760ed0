//! Writes the frames of a stream to a file on a thread of its own, so that a disk that stalls costs nothing as long as the
//! queue between them lasts.

use std::fs::File;
use std::io::{self, Seek as _, Write};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};

use ddx_video::frame::Frame;
use ddx_video::y4m::{Header, Mark, Writer};

use crate::error::Failure;

/// What frames are written to: a file, or what a test puts in its place.
pub(crate) trait Sink: Write + Send + 'static {
    /// Cuts off what was written after the first `len` bytes.
    fn cut(&mut self, len: u64) -> io::Result<()>;
}

impl Sink for File {
    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.set_len(len)?;
        self.seek(io::SeekFrom::Start(len)).map(|_| ())
    }
}

/// The thread that writes, and the queue before it.
#[derive(Debug)]
pub(crate) struct Recorder {
    queue: SyncSender<(Vec<u8>, Mark)>,
    /// Memory of frames that were written.
    spare: Arc<Mutex<Vec<Vec<u8>>>>,
    thread: JoinHandle<Result<Written, Failure>>,
}

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Written {
    pub(crate) frames: u64,
    pub(crate) bytes: u64,
}

/// Why a frame was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refused {
    /// The disk is too slow.
    Full,
    /// Writing has failed: [`Recorder::finish`] says how.
    Ended,
}

impl Recorder {
    /// Starts the thread. `room` is the number of frames that may wait, all of whose memory is taken now.
    pub(crate) fn start(
        sink: impl Sink,
        header: Header,
        room: usize,
        frame_bytes: usize,
    ) -> Result<Self, Failure> {
        let (queue, frames) = sync_channel(room);
        let spare = Arc::new(Mutex::new(vec![vec![0; frame_bytes]; room]));
        let back = Arc::clone(&spare);
        let thread = thread::Builder::new()
            .name("ddx-save".to_owned())
            .spawn(move || write(sink, header, &frames, &back))?;
        Ok(Self {
            queue,
            spare,
            thread,
        })
    }

    /// Copies a frame into the queue.
    pub(crate) fn take(&self, bytes: &[u8], mark: Mark) -> Result<(), Refused> {
        let spare = self.spare.lock().ok().and_then(|mut spare| spare.pop());
        let mut copy = spare.ok_or(Refused::Full)?;
        copy.clear();
        copy.extend_from_slice(bytes);
        self.queue
            .try_send((copy, mark))
            .map_err(|error| match error {
                TrySendError::Full((copy, _)) => {
                    give_back(&self.spare, copy);
                    Refused::Full
                }
                TrySendError::Disconnected(_) => Refused::Ended,
            })
    }

    /// Waits until all that was taken is written.
    pub(crate) fn finish(self) -> Result<Written, Failure> {
        drop(self.queue);
        self.thread
            .join()
            .unwrap_or_else(|_| Err(Failure::new("the writing thread panicked")))
    }
}

/// Counts what goes through it.
struct Counted<S: Write> {
    sink: io::BufWriter<S>,
    bytes: u64,
}

impl<S: Write> Write for Counted<S> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.sink.write(bytes)?;
        self.bytes += u64::try_from(written).unwrap_or_default();
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.sink.flush()
    }
}

fn write(
    sink: impl Sink,
    header: Header,
    frames: &Receiver<(Vec<u8>, Mark)>,
    spare: &Mutex<Vec<Vec<u8>>>,
) -> Result<Written, Failure> {
    let sink = Counted {
        sink: io::BufWriter::with_capacity(BUFFER_BYTES, sink),
        bytes: 0,
    };
    let mut writer = Writer::new(sink, header)?;
    let mut written = Written {
        frames: 0,
        bytes: writer.output_mut().bytes,
    };
    for (bytes, mark) in frames {
        let frame = Frame::parse(&bytes)?;
        let done = writer
            .write(&frame, mark)
            .and_then(|()| writer.output_mut().flush().map_err(ddx_video::Error::Write));
        if let Err(error) = done {
            // What is there of the frame is of no use to anybody.
            let (mut sink, _unwritten) = writer.into_output().sink.into_parts();
            let cut = sink.cut(written.bytes);
            let failure = Failure::from(error);
            return Err(match cut {
                Ok(()) => failure.with_hint(format!(
                    "the first {} frames are whole: the file ends behind them",
                    written.frames
                )),
                Err(_) => failure,
            });
        }
        written.frames += 1;
        written.bytes = writer.output_mut().bytes;
        give_back(spare, bytes);
    }
    Ok(written)
}

fn give_back(spare: &Mutex<Vec<Vec<u8>>>, bytes: Vec<u8>) {
    if let Ok(mut spare) = spare.lock() {
        spare.push(bytes);
    }
}

const BUFFER_BYTES: usize = 1 << 20;

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use ddx_video::PixelFormat;
    use ddx_video::frame::{FieldSpec, FrameInfo, Layout};
    use ddx_video::y4m::Reader;

    use super::*;

    /// A disk that stalls once, and may be full.
    #[derive(Clone, Default)]
    struct Disk {
        bytes: Arc<Mutex<Vec<u8>>>,
        stall: Duration,
        room: Option<usize>,
    }

    impl Disk {
        fn file(&self) -> std::sync::MutexGuard<'_, Vec<u8>> {
            self.bytes.lock().unwrap()
        }
    }

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            thread::sleep(std::mem::take(&mut self.stall));
            let mut file = self.file();
            let room = self.room.map_or(usize::MAX, |room| room - file.len());
            if room == 0 {
                return Err(io::ErrorKind::StorageFull.into());
            }
            let len = bytes.len().min(room);
            file.extend_from_slice(&bytes[..len]);
            Ok(len)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Sink for Disk {
        fn cut(&mut self, len: u64) -> io::Result<()> {
            let len = usize::try_from(len).unwrap_or(usize::MAX);
            let mut file = self.file();
            file.truncate(len);
            Ok(())
        }
    }

    fn layout() -> Layout {
        Layout::new(&[FieldSpec::new("picture", PixelFormat::I420, 64, 48)]).unwrap()
    }

    fn frame(layout: &Layout, sequence: u64) -> Vec<u8> {
        let mut bytes = vec![u8::try_from(sequence % 251).unwrap(); layout.size_bytes()];
        let info = FrameInfo {
            sequence,
            ..FrameInfo::default()
        };
        layout.write_header(&mut bytes, &info).unwrap();
        bytes
    }

    fn record(disk: &Disk, room: usize, frames: u64) -> (u64, Result<Written, Failure>) {
        let layout = layout();
        let header = Header::of(&layout, Some((30, 1))).unwrap();
        let recorder = Recorder::start(disk.clone(), header, room, layout.size_bytes()).unwrap();
        let (start, mut dropped) = (Instant::now(), 0);
        for sequence in 1..=frames {
            let due = Duration::from_millis(10) * u32::try_from(sequence).unwrap();
            thread::sleep(due.saturating_sub(start.elapsed()));
            let mark = Mark {
                sequence: Some(sequence),
                ..Mark::default()
            };
            let taken = recorder.take(&frame(&layout, sequence), mark);
            dropped += u64::from(taken == Err(Refused::Full));
        }
        (dropped, recorder.finish())
    }

    fn frames(disk: &Disk) -> Vec<u64> {
        let file = disk.file();
        let mut reader = Reader::new(file.as_slice()).unwrap();
        let mut bytes = vec![0; layout().size_bytes()];
        let mut all = Vec::new();
        while let Some(mark) = reader.next_mark().unwrap() {
            reader.read_planes(&mut bytes).unwrap();
            all.extend(mark.sequence);
        }
        all
    }

    #[test]
    fn a_disk_that_stalls_costs_no_frame_while_the_queue_lasts() {
        for stall_ms in [800, 2_000] {
            let disk = Disk {
                stall: Duration::from_millis(stall_ms),
                ..Disk::default()
            };
            let (dropped, written) = record(&disk, 300, 250);
            assert_eq!(
                (dropped, written.unwrap().frames),
                (0, 250),
                "{stall_ms} ms"
            );
            assert_eq!(frames(&disk), (1..=250).collect::<Vec<_>>());
        }
    }

    #[test]
    fn what_the_queue_has_no_room_for_is_counted() {
        let disk = Disk {
            stall: Duration::from_millis(800),
            ..Disk::default()
        };
        let (dropped, written) = record(&disk, 20, 100);
        assert!(dropped > 30, "{dropped}");
        assert_eq!(written.unwrap().frames, 100 - dropped);
    }

    #[test]
    fn a_full_disk_leaves_whole_frames() {
        let disk = Disk {
            room: Some(20_000),
            ..Disk::default()
        };
        let (_, written) = record(&disk, 50, 20);
        let failure = written.unwrap_err().to_string();
        assert!(
            failure.contains("the first 4 frames are whole"),
            "{failure}"
        );
        assert_eq!(frames(&disk), [1, 2, 3, 4]);
    }
}
