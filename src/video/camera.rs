//! A camera as a source: captures only while somebody reads, and goes on when it was unplugged and is back.

use std::io;
use std::time::Duration;

use ddx_video::PixelFormat;
use ddx_video::frame::{FieldSpec, FrameInfo, Layout};
use ddx_video::gather::gather;
use serde_json::{Value, json};

use super::StreamWriter;
use crate::error::Failure;

/// What is asked of a camera; it answers with a [`Mode`] near it.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Wanted {
    pub(crate) format: Option<PixelFormat>,
    pub(crate) size: Option<(u32, u32)>,
    /// Frames a second.
    pub(crate) rate: Option<f64>,
}

/// What a camera gives.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Mode {
    pub(crate) format: PixelFormat,
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// From row to row of the first plane.
    pub(crate) bytes_per_line: usize,
}

/// One setting of a camera.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Control {
    pub(crate) name: String,
    pub(crate) value: i32,
    pub(crate) least: i32,
    pub(crate) most: i32,
    pub(crate) default: i32,
}

/// Where a camera is plugged in, or is not.
pub(crate) trait Port {
    type Camera: Camera;
    /// Opens it in a mode near the wanted one; nothing is captured yet.
    fn open(&mut self, wanted: &Wanted) -> io::Result<Self::Camera>;
}

/// A camera that is plugged in. An error of any call means that it is not any longer.
pub(crate) trait Camera {
    fn mode(&self) -> &Mode;
    fn start(&mut self) -> io::Result<()>;
    fn stop(&mut self) -> io::Result<()>;
    /// Waits for the next picture and shows it to `take`; false when none came in time.
    fn next(&mut self, timeout: Duration, take: impl FnOnce(&[u8])) -> io::Result<bool>;
    fn controls(&mut self) -> io::Result<Vec<Control>>;
    fn set(&mut self, control: &str, value: i32) -> io::Result<()>;
}

/// Where frames go.
pub(crate) trait Sink {
    /// Whether somebody, on any host, reads.
    fn is_read(&self) -> bool;
    /// Publishes the frame of that number unless there is not enough of it, and tells whether; `dropped` came damaged until
    /// now.
    fn publish(&mut self, number: u64, dropped: u64, fill: Fill<'_>) -> Result<bool, Failure>;
    /// Tells the settings that hold from a frame on.
    fn tell(&mut self, controls: &[Control], from: u64) -> Result<(), Failure>;
}

/// Copies a picture into a frame; false when there is not enough of it.
pub(crate) type Fill<'a> = &'a dyn Fn(&Layout, &mut [u8]) -> bool;

/// The machine between a port and a stream.
#[derive(Debug)]
pub(crate) struct Capture<P: Port> {
    port: P,
    wanted: Wanted,
    settings: Vec<(String, i32)>,
    /// Of so many pictures one is published.
    divider: u64,
    mode: Mode,
    camera: Option<P::Camera>,
    is_streaming: bool,
    captured: u64,
    published: u64,
    dropped: u64,
    controls: Vec<Control>,
}

/// What a turn of the machine came to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Turn {
    /// There is nothing to do for so long.
    Idle(Duration),
    /// A picture came, or the time for one is over.
    Captured,
    /// The camera is gone, and why.
    Gone(String),
    /// It is back.
    Back,
}

impl<P: Port> Capture<P> {
    /// Opens the camera, which must be there now.
    pub(crate) fn open(
        mut port: P,
        wanted: Wanted,
        settings: Vec<(String, i32)>,
        divider: u64,
    ) -> Result<Self, Failure> {
        let mut camera = port.open(&wanted)?;
        set_all(&mut camera, &settings)?;
        Ok(Self {
            port,
            wanted,
            settings,
            divider: divider.max(1),
            mode: camera.mode().clone(),
            camera: Some(camera),
            is_streaming: false,
            captured: 0,
            published: 0,
            dropped: 0,
            controls: Vec::new(),
        })
    }

    /// The mode of all its frames.
    pub(crate) fn mode(&self) -> &Mode {
        &self.mode
    }

    /// Frames that were published, and pictures that came damaged.
    pub(crate) fn counts(&self) -> (u64, u64) {
        (self.published, self.dropped)
    }

    /// Does the next thing; `timeout` is the longest that it waits for a picture.
    pub(crate) fn turn(
        &mut self,
        sink: &mut impl Sink,
        timeout: Duration,
    ) -> Result<Turn, Failure> {
        let Some(camera) = &mut self.camera else {
            return self.reopen();
        };
        if !sink.is_read() {
            if std::mem::take(&mut self.is_streaming)
                && let Err(error) = camera.stop()
            {
                return Ok(self.lose(&error));
            }
            return Ok(Turn::Idle(UNREAD));
        }
        if !self.is_streaming {
            if let Err(error) = camera.start() {
                return Ok(self.lose(&error));
            }
            self.is_streaming = true;
        }
        let (captured, divider) = (self.captured, self.divider);
        let (published, dropped) = (self.published, self.dropped);
        let line = self.mode.bytes_per_line;
        let mut done = None;
        let came = camera.next(timeout, |bytes| {
            if captured % divider == 0 {
                let fill =
                    |layout: &Layout, frame: &mut [u8]| gather(layout, frame, bytes, line).is_ok();
                done = Some(sink.publish(published + 1, dropped, &fill));
            }
        });
        match came {
            Ok(true) => {
                self.captured += 1;
                match done.transpose()? {
                    Some(true) => self.published += 1,
                    Some(false) => self.dropped += 1,
                    None => {}
                }
                self.watch(sink)?;
                Ok(Turn::Captured)
            }
            Ok(false) => Ok(Turn::Captured),
            Err(error) => Ok(self.lose(&error)),
        }
    }

    /// Tells of settings that are not what they were, whoever changed them.
    fn watch(&mut self, sink: &mut impl Sink) -> Result<(), Failure> {
        if self.captured % WATCHED_EACH != 1 {
            return Ok(());
        }
        let Some(Ok(controls)) = self.camera.as_mut().map(Camera::controls) else {
            return Ok(());
        };
        if controls != self.controls {
            sink.tell(&controls, self.published.max(1))?;
            self.controls = controls;
        }
        Ok(())
    }

    fn lose(&mut self, error: &io::Error) -> Turn {
        self.camera = None;
        self.is_streaming = false;
        Turn::Gone(error.to_string())
    }

    fn reopen(&mut self) -> Result<Turn, Failure> {
        let Ok(mut camera) = self.port.open(&self.wanted) else {
            return Ok(Turn::Idle(UNPLUGGED));
        };
        let mode = camera.mode();
        if *mode != self.mode {
            return Err(Failure::new(format!(
                "the camera came back with {}x{} {}, other frames than before",
                mode.width, mode.height, mode.format
            )));
        }
        set_all(&mut camera, &self.settings)?;
        self.camera = Some(camera);
        Ok(Turn::Back)
    }
}

impl Mode {
    /// The layout of its frames.
    pub(crate) fn layout(&self) -> Result<Layout, ddx_video::Error> {
        Layout::new(&[FieldSpec::new(
            "picture",
            self.format,
            self.width,
            self.height,
        )])
    }
}

impl Sink for (StreamWriter, &str) {
    fn is_read(&self) -> bool {
        self.0.readers() > 0
    }

    fn publish(&mut self, number: u64, dropped: u64, fill: Fill<'_>) -> Result<bool, Failure> {
        let published = self.0.publish(dropped, |layout, bytes| {
            // The driver has just handed it over: nothing tells more exactly when it was taken.
            let now = ddx_store::now();
            let info = FrameInfo {
                sequence: number,
                capture_ns: now.0,
                ..FrameInfo::default()
            };
            layout.write_header(bytes, &info)?;
            Ok(fill(layout, bytes).then_some((info, now)))
        })?;
        Ok(published.is_some())
    }

    fn tell(&mut self, controls: &[Control], from: u64) -> Result<(), Failure> {
        let values = controls
            .iter()
            .map(|control| (control.name.clone(), json!(control.value)));
        let values: Value = values.collect::<serde_json::Map<_, _>>().into();
        self.0.tell(self.1, &values, from)
    }
}

fn set_all(camera: &mut impl Camera, settings: &[(String, i32)]) -> Result<(), Failure> {
    for (name, value) in settings {
        let known = camera.controls()?;
        let Some(control) = known.iter().find(|control| control.name == *name) else {
            let names: Vec<_> = known.iter().map(|control| control.name.as_str()).collect();
            return Err(
                Failure::arguments(format!("the camera has no control `{name}`"))
                    .with_hint(format!("it has {}", names.join(", "))),
            );
        };
        if !(control.least..=control.most).contains(value) {
            return Err(Failure::arguments(format!(
                "control `{name}` is {} to {}, not {value}",
                control.least, control.most
            )));
        }
        camera.set(name, *value)?;
    }
    Ok(())
}

/// How late a first reader may be noticed.
const UNREAD: Duration = Duration::from_millis(20);
/// How late a camera that is back may be noticed.
const UNPLUGGED: Duration = Duration::from_millis(500);
/// Pictures after which the settings are looked at again.
const WATCHED_EACH: u64 = 30;

#[cfg(test)]
mod tests {
    use std::cell::RefCell;
    use std::rc::Rc;

    use super::*;

    /// A device: what it does is in the hand of the test.
    #[derive(Debug)]
    struct Device {
        is_there: bool,
        width: u32,
        is_short: bool,
        streams: u32,
        starts: u32,
        gain: i32,
    }

    #[derive(Clone, Debug)]
    struct Fake(Rc<RefCell<Device>>);

    #[derive(Debug)]
    struct Plugged(Rc<RefCell<Device>>, Mode);

    #[derive(Default)]
    struct Published {
        readers: u32,
        frames: Vec<(u64, u64)>,
        told: Vec<(i32, u64)>,
    }

    fn gone() -> io::Error {
        io::Error::from_raw_os_error(19)
    }

    impl Port for Fake {
        type Camera = Plugged;

        fn open(&mut self, wanted: &Wanted) -> io::Result<Plugged> {
            let device = self.0.borrow();
            let mode = Mode {
                format: wanted.format.unwrap_or(PixelFormat::Yuyv),
                width: device.width,
                height: 4,
                bytes_per_line: 64,
            };
            let plugged = Plugged(Rc::clone(&self.0), mode);
            device.is_there.then_some(plugged).ok_or_else(gone)
        }
    }

    impl Camera for Plugged {
        fn mode(&self) -> &Mode {
            &self.1
        }

        fn start(&mut self) -> io::Result<()> {
            let mut device = self.0.borrow_mut();
            (device.streams, device.starts) = (1, device.starts + 1);
            Ok(())
        }

        fn stop(&mut self) -> io::Result<()> {
            self.0.borrow_mut().streams = 0;
            Ok(())
        }

        fn next(&mut self, _: Duration, take: impl FnOnce(&[u8])) -> io::Result<bool> {
            let (is_there, is_short) = {
                let device = self.0.borrow();
                (device.is_there && device.streams > 0, device.is_short)
            };
            if !is_there {
                return Err(gone());
            }
            take(&vec![7; if is_short { 9 } else { 64 * 4 }]);
            Ok(true)
        }

        fn controls(&mut self) -> io::Result<Vec<Control>> {
            Ok(vec![Control {
                name: "gain".to_owned(),
                value: self.0.borrow().gain,
                least: 0,
                most: 10,
                default: 5,
            }])
        }

        fn set(&mut self, _: &str, value: i32) -> io::Result<()> {
            self.0.borrow_mut().gain = value;
            Ok(())
        }
    }

    impl Sink for Published {
        fn is_read(&self) -> bool {
            self.readers > 0
        }

        fn publish(&mut self, number: u64, dropped: u64, fill: Fill<'_>) -> Result<bool, Failure> {
            let spec = FieldSpec::new("a", PixelFormat::Yuyv, 16, 4);
            let layout = Layout::new(&[spec])?;
            let mut frame = vec![0; layout.size_bytes()];
            let is_whole = fill(&layout, &mut frame) && frame.ends_with(&[7; 32]);
            if is_whole {
                self.frames.push((number, dropped));
            }
            Ok(is_whole)
        }

        fn tell(&mut self, controls: &[Control], from: u64) -> Result<(), Failure> {
            self.told.push((controls[0].value, from));
            Ok(())
        }
    }

    fn device() -> Fake {
        Fake(Rc::new(RefCell::new(Device {
            is_there: true,
            width: 16,
            is_short: false,
            streams: 0,
            starts: 0,
            gain: 5,
        })))
    }

    fn capture(fake: &Fake, divider: u64) -> Capture<Fake> {
        Capture::open(fake.clone(), Wanted::default(), Vec::new(), divider).unwrap()
    }

    fn turns(capture: &mut Capture<Fake>, sink: &mut Published, count: usize) -> Vec<Turn> {
        let turn = |_| capture.turn(sink, Duration::ZERO).unwrap();
        (0..count).map(turn).collect()
    }

    #[test]
    fn nothing_is_captured_while_nobody_reads() {
        let (fake, mut sink) = (device(), Published::default());
        let mut capture = capture(&fake, 1);
        assert_eq!(
            turns(&mut capture, &mut sink, 2),
            [Turn::Idle(UNREAD), Turn::Idle(UNREAD)]
        );
        assert_eq!(fake.0.borrow().starts, 0);
        sink.readers = 1;
        turns(&mut capture, &mut sink, 3);
        sink.readers = 0;
        turns(&mut capture, &mut sink, 2);
        assert_eq!((fake.0.borrow().starts, fake.0.borrow().streams), (1, 0));
        assert_eq!(sink.frames, [(1, 0), (2, 0), (3, 0)]);
        sink.readers = 2;
        turns(&mut capture, &mut sink, 1);
        assert_eq!((fake.0.borrow().starts, capture.counts()), (2, (4, 0)));
    }

    #[test]
    fn a_camera_that_was_unplugged_goes_on_with_its_settings() {
        let (fake, mut sink) = (device(), Published::default());
        let settings = vec![("gain".to_owned(), 8)];
        let mut capture = Capture::open(fake.clone(), Wanted::default(), settings, 1).unwrap();
        sink.readers = 1;
        turns(&mut capture, &mut sink, 2);
        fake.0.borrow_mut().is_there = false;
        let lost = turns(&mut capture, &mut sink, 3);
        assert!(
            matches!(&lost[0], Turn::Gone(why) if why.contains("No such device")),
            "{lost:?}"
        );
        assert_eq!(lost[1..], [Turn::Idle(UNPLUGGED), Turn::Idle(UNPLUGGED)]);
        (fake.0.borrow_mut().is_there, fake.0.borrow_mut().gain) = (true, 5);
        assert_eq!(
            turns(&mut capture, &mut sink, 2),
            [Turn::Back, Turn::Captured]
        );
        assert_eq!(fake.0.borrow().gain, 8);
        assert_eq!(sink.frames.last(), Some(&(3, 0)));

        fake.0.borrow_mut().is_there = false;
        turns(&mut capture, &mut sink, 1);
        (fake.0.borrow_mut().is_there, fake.0.borrow_mut().width) = (true, 32);
        let error = capture.turn(&mut sink, Duration::ZERO).unwrap_err();
        assert!(error.to_string().contains("32x4 YUYV"), "{error}");
    }

    #[test]
    fn of_some_pictures_one_is_published_and_damaged_ones_are_counted() {
        let (fake, mut sink) = (device(), Published::default());
        let mut capture = capture(&fake, 3);
        sink.readers = 1;
        turns(&mut capture, &mut sink, 7);
        fake.0.borrow_mut().is_short = true;
        turns(&mut capture, &mut sink, 3);
        fake.0.borrow_mut().is_short = false;
        turns(&mut capture, &mut sink, 3);
        assert_eq!(sink.frames, [(1, 0), (2, 0), (3, 0), (4, 1)]);
        assert_eq!(capture.counts(), (4, 1));
    }

    #[test]
    fn settings_are_checked_and_told_when_anybody_changes_them() {
        let (fake, mut sink) = (device(), Published::default());
        for (name, value, expected) in [("zoom", 1, "it has gain"), ("gain", 11, "0 to 10")] {
            let settings = vec![(name.to_owned(), value)];
            let refused = Capture::open(fake.clone(), Wanted::default(), settings, 1).unwrap_err();
            assert!(refused.to_string().contains(expected), "{refused}");
        }
        let mut capture = capture(&fake, 1);
        sink.readers = 1;
        turns(&mut capture, &mut sink, 40);
        fake.0.borrow_mut().gain = 9;
        turns(&mut capture, &mut sink, 40);
        assert_eq!(sink.told, [(5, 1), (9, 61)]);
    }
}
