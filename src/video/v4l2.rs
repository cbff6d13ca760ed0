//! Cameras of the kernel's V4L2, by the crate `linuxvideo`.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use ddx_video::PixelFormat;
use linuxvideo::format::{PixFormat, PixelFormat as FourCc};
use linuxvideo::stream::ReadStream;
use linuxvideo::{BufType, CapabilityFlags, Device, Fract};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;

use crate::units;

use super::camera::{Camera, Control, Mode, Port, Wanted};

/// The file of a device.
#[derive(Clone, Debug)]
pub(crate) struct Socket {
    path: PathBuf,
}

/// An open device.
pub(crate) struct Plugged {
    path: PathBuf,
    /// For its settings: what streams is taken by the stream.
    control: Device,
    wanted: Wanted,
    mode: Mode,
    stream: Option<ReadStream>,
}

impl Socket {
    /// Finds a device by its number, its file, or its name below `/dev/v4l/by-id`.
    pub(crate) fn new(device: &str) -> Self {
        let by_id = Path::new("/dev/v4l/by-id").join(device);
        let path = match device.parse::<u32>() {
            Ok(number) => PathBuf::from(format!("/dev/video{number}")),
            Err(_) if !device.contains('/') && by_id.exists() => by_id,
            Err(_) => PathBuf::from(device),
        };
        Self { path }
    }

    /// The file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// What it is called, the formats that it gives, and its settings.
    pub(crate) fn describe(&self) -> io::Result<(String, Vec<String>, Vec<Control>)> {
        let device = capturing(&self.path)?;
        let name = device.capabilities()?.card().to_owned();
        let mut formats = Vec::new();
        for format in device.formats(BufType::VIDEO_CAPTURE) {
            let format = format?;
            let known = known(format.pixel_format()).map_or("not known here", PixelFormat::name);
            formats.push(format!("{} ({known})", format.description()));
        }
        Ok((name, formats, controls(&device)?))
    }
}

impl Port for Socket {
    type Camera = Plugged;

    fn open(&mut self, wanted: &Wanted) -> io::Result<Plugged> {
        let (mode, _) = configured(&self.path, wanted)?;
        Ok(Plugged {
            path: self.path.clone(),
            control: capturing(&self.path)?,
            wanted: wanted.clone(),
            mode,
            stream: None,
        })
    }
}

impl Camera for Plugged {
    fn mode(&self) -> &Mode {
        &self.mode
    }

    fn start(&mut self) -> io::Result<()> {
        let (mode, device) = configured(&self.path, &self.wanted)?;
        if mode != self.mode {
            return Err(io::Error::other("another program has changed its format"));
        }
        self.stream = Some(device.into_stream()?);
        Ok(())
    }

    fn stop(&mut self) -> io::Result<()> {
        self.stream = None;
        Ok(())
    }

    fn next(&mut self, timeout: Duration, take: impl FnOnce(&[u8])) -> io::Result<bool> {
        let Some(stream) = &mut self.stream else {
            return Ok(false);
        };
        let timeout = Timespec::try_from(timeout).map_err(io::Error::other)?;
        let mut fds = [PollFd::new(&*stream, PollFlags::IN)];
        match poll(&mut fds, Some(&timeout)) {
            Ok(0) | Err(Errno::INTR) => return Ok(false),
            Ok(_) => {}
            Err(error) => return Err(error.into()),
        }
        // After an unplug this says so, where the flags of the descriptor differ by driver.
        stream.dequeue(|view| {
            let bytes: &[u8] = &view;
            take(if view.is_error() { &[] } else { bytes });
            Ok(())
        })?;
        Ok(true)
    }

    fn controls(&mut self) -> io::Result<Vec<Control>> {
        controls(&self.control)
    }

    fn set(&mut self, control: &str, value: i32) -> io::Result<()> {
        let found = self
            .control
            .controls()
            .filter_map(Result::ok)
            .find(|known| spelled(known.name()) == control);
        let id = found.ok_or(io::ErrorKind::NotFound)?.id();
        self.control.write_control_raw(id, value)
    }
}

fn capturing(path: &Path) -> io::Result<Device> {
    let device = Device::open(path).map_err(|error| match Errno::from_io_error(&error) {
        Some(Errno::NOTTY) => io::Error::other("it is no device of V4L2"),
        _ => error,
    })?;
    let can = device.capabilities()?.device_capabilities();
    if can.contains(CapabilityFlags::VIDEO_CAPTURE) {
        Ok(device)
    } else {
        Err(io::Error::other("it is no camera: it captures nothing"))
    }
}

fn configured(path: &Path, wanted: &Wanted) -> io::Result<(Mode, linuxvideo::VideoCaptureDevice)> {
    let device = capturing(path)?;
    let mut given = Vec::new();
    for format in device.formats(BufType::VIDEO_CAPTURE) {
        given.push(format?.pixel_format());
    }
    let is_given = |code: &[u8; 4]| given.contains(&FourCc::from_fourcc(*code));
    let mut usable = FORMATS.iter().filter(|(code, _)| is_given(code));
    let chosen = match wanted.format {
        None => usable.next(),
        Some(format) => usable.find(|(_, known)| *known == format),
    };
    let Some((code, format)) = chosen else {
        let given: Vec<_> = given
            .iter()
            .map(|code| String::from_utf8_lossy(&code.as_fourcc()).into_owned())
            .collect();
        return Err(io::Error::other(format!(
            "it gives no pixels of that format but {} (hint: ffmpeg decodes MJPG and others for `ddx video load -`)",
            given.join(", ")
        )));
    };
    let (width, height) = wanted.size.unwrap_or(USUAL);
    let asked = PixFormat::new(width, height, FourCc::from_fourcc(*code));
    let device = device.video_capture(asked)?;
    let got = device.format();
    if got.pixel_format().as_fourcc() != *code {
        return Err(io::Error::other("it gives other pixels than it says"));
    }
    let mode = Mode {
        format: *format,
        width: got.width(),
        height: got.height(),
        bytes_per_line: usize::try_from(got.bytes_per_line()).map_err(io::Error::other)?,
    };
    if let Some(rate) = wanted.rate {
        let interval = Fract::new(
            1_000,
            u32::try_from(units::whole(rate * 1_000.0)).map_err(io::Error::other)?,
        );
        // Not every driver has a choice, and then says that it does not know the question.
        let _chosen = device.set_frame_interval(interval);
    }
    Ok((mode, device))
}

fn controls(device: &Device) -> io::Result<Vec<Control>> {
    let mut all = Vec::new();
    for control in device.controls() {
        let control = control?;
        // Those that only are written, as buttons, have no value.
        if let Ok(value) = device.read_control_raw(control.id()) {
            all.push(Control {
                name: spelled(control.name()),
                value,
                least: control.minimum(),
                most: control.maximum(),
                default: control.default_value(),
            });
        }
    }
    Ok(all)
}

/// `White Balance, Automatic` as one types it: `white_balance_automatic`.
fn spelled(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric());
    let words: Vec<_> = words.filter(|word| !word.is_empty()).collect();
    words.join("_").to_ascii_lowercase()
}

fn known(code: FourCc) -> Option<PixelFormat> {
    let mut all = FORMATS.iter();
    all.find(|(known, _)| FourCc::from_fourcc(*known) == code)
        .map(|(_, format)| *format)
}

/// Codes of V4L2 (Documentation/userspace-api/media/v4l/pixfmt.rst), those first that are preferred.
const FORMATS: [([u8; 4], PixelFormat); 13] = [
    (*b"YU12", PixelFormat::I420),
    (*b"NV12", PixelFormat::Nv12),
    (*b"YUYV", PixelFormat::Yuyv),
    (*b"UYVY", PixelFormat::Uyvy),
    (*b"422P", PixelFormat::I422),
    (*b"444P", PixelFormat::I444),
    (*b"411P", PixelFormat::I411),
    (*b"RGB3", PixelFormat::Rgb24),
    (*b"BGR3", PixelFormat::Bgr24),
    (*b"AB24", PixelFormat::Rgba),
    (*b"GREY", PixelFormat::Grey8),
    (*b"Y16 ", PixelFormat::Grey16),
    (*b"Z16 ", PixelFormat::Grey16),
];
const USUAL: (u32, u32) = (640, 480);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_are_found_by_number_file_or_name() {
        assert_eq!(Socket::new("2").path(), Path::new("/dev/video2"));
        assert_eq!(Socket::new("/dev/video0").path(), Path::new("/dev/video0"));
        assert_eq!(Socket::new("no-such").path(), Path::new("no-such"));
        assert_eq!(
            spelled("White Balance, Automatic"),
            "white_balance_automatic"
        );
    }

    #[test]
    fn what_is_no_camera_is_refused() {
        for path in ["/nonexistent", "/dev/null", "/dev/zero"] {
            assert!(
                Socket::new(path).open(&Wanted::default()).is_err(),
                "{path}"
            );
        }
    }

    #[test]
    fn each_format_that_a_camera_has_has_a_code() {
        let known: Vec<_> = FORMATS.iter().map(|(_, format)| *format).collect();
        let all = PixelFormat::ALL.into_iter();
        assert!(
            all.filter(|format| *format != PixelFormat::Hsy)
                .all(|format| known.contains(&format))
        );
    }
}
