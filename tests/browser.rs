//! What Chromium makes of `ddx video serve`: the page with its streams, and the picture of the chosen one, alive.
//!
//! What it showed is in `browser` of the target directory, for people.

#![expect(
    clippy::unwrap_used,
    reason = "a helper of a test fails the test, as the test itself would"
)]

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use ddx_video::convert::{Rgb, to_rgb};
use ddx_video::format::PixelFormat;
use ddx_video::frame::{FieldSpec, Frame, FrameInfo, Layout};
use ddx_video::{pattern, y4m};
use serde_json::Value;

/// A host with two streams and a server, in a directory that goes with it.
struct Site {
    dir: PathBuf,
    // In reverse order of their start.
    children: Vec<Child>,
}

#[test]
fn chromium_shows_the_picture_of_the_chosen_stream() {
    let chromium = Command::new(CHROMIUM).arg("--version").output();
    if let Err(fault) = chromium {
        assert!(std::env::var_os("CI").is_none(), "{CHROMIUM}: {fault}");
        eprintln!(
            "!!!! SKIPPED, NOTHING PROVEN: {CHROMIUM}: {fault} (hint: apt-get install chromium)"
        );
        return;
    }
    let mut site = Site::start();
    let size = format!("{WIDTH}x{HEIGHT}");
    site.background(&["video", "load", CLIP, "--name", "film", "--loop"]);
    site.background(&["video", "pattern", "--name", "cam", "--size", &size]);
    let said = site.first_line(&["video", "serve", "--listen", "127.0.0.1:0"]);
    let url = said["url"].as_str().unwrap();

    wait("page with both streams", || {
        let dom = site.browse(&format!("{url}#robot1%2Ffilm"), "--dump-dom");
        let names = [
            r#"<button aria-current="true"><b>robot1/film</b>"#,
            r#"<button aria-current="false"><b>robot1/cam</b>"#,
            r#"<b id="name">robot1/film</b>"#,
        ];
        names
            .iter()
            .all(|name| dom.contains(name))
            .then_some(())
            .ok_or(dom)
    });
    let film = film();
    let place = wait("picture of the film", || {
        let shot = site.shot(url, "film");
        film.iter()
            .find_map(|picture| find(&shot, picture))
            .ok_or("none of its frames".to_owned())
    });
    let before = ddx_store::now();
    wait("picture of the pattern that was taken since", || {
        let shot = site.shot(url, "cam");
        match stamp(&shot, place).unwrap() {
            Some(stamp) if stamp.time_ns > before.0 => Ok(()),
            other => Err(format!("{other:?}")),
        }
    });
}

/// Looks again and again until there is what is waited for.
fn wait<T>(what: &str, mut look: impl FnMut() -> Result<T, String>) -> T {
    let start = Instant::now();
    loop {
        match look() {
            Ok(found) => return found,
            Err(seen) => assert!(
                start.elapsed() < PATIENCE,
                "no {what} within {PATIENCE:?}; last seen: {seen}"
            ),
        }
    }
}

/// The pictures of the clip.
fn film() -> Vec<Rgb> {
    let mut reader = y4m::Reader::new(BufReader::new(File::open(CLIP).unwrap())).unwrap();
    let layout = reader.layout().clone();
    let mut bytes = vec![0; layout.size_bytes()];
    layout
        .write_header(&mut bytes, &FrameInfo::default())
        .unwrap();
    let mut pictures = Vec::new();
    while reader.next_mark().unwrap().is_some() {
        reader.read_planes(&mut bytes).unwrap();
        pictures.push(to_rgb(&Frame::parse(&bytes).unwrap().first()).unwrap());
    }
    pictures
}

/// Where in a screenshot a picture is, but for what JPEG did to it.
fn find(shot: &Rgb, picture: &Rgb) -> Option<(u32, u32)> {
    let columns = 0..=shot.width.checked_sub(picture.width)?;
    let rows = 0..=shot.height.checked_sub(picture.height)?;
    rows.flat_map(|y| columns.clone().map(move |x| (x, y)))
        .find(|at| differs_by(shot, *at, picture, 16) && differs_by(shot, *at, picture, 1))
}

/// Whether each `step`th pixel of each `step`th row differs by no more than [`LOSSY`] in the mean.
fn differs_by(shot: &Rgb, (left, top): (u32, u32), picture: &Rgb, step: usize) -> bool {
    let pixels = (0..picture.height)
        .step_by(step)
        .flat_map(|y| (0..picture.width).step_by(step).map(move |x| (x, y)));
    let most = LOSSY * u32::try_from(pixels.clone().count() * 3).unwrap();
    let mut sum = 0;
    for (x, y) in pixels {
        let (seen, is) = (pixel(shot, left + x, top + y), pixel(picture, x, y));
        sum += seen
            .iter()
            .zip(is)
            .map(|(a, b)| u32::from(a.abs_diff(*b)))
            .sum::<u32>();
        if sum > most {
            return false;
        }
    }
    true
}

fn pixel(rgb: &Rgb, x: u32, y: u32) -> &[u8] {
    let at = usize::try_from((y * rgb.width + x) * 3).unwrap();
    &rgb.bytes[at..at + 3]
}

/// What the pattern says in this place of a screenshot.
fn stamp(shot: &Rgb, (left, top): (u32, u32)) -> Result<Option<pattern::Stamp>, ddx_video::Error> {
    let spec = FieldSpec::new("shot", PixelFormat::Rgb24, WIDTH, HEIGHT);
    let layout = Layout::new(&[spec])?;
    let mut frame = vec![0; layout.size_bytes()];
    layout.write_header(&mut frame, &FrameInfo::default())?;
    for plane in layout.planes_mut(&mut frame, 0) {
        for (y, row) in (top..).zip(plane.bytes.chunks_mut(plane.stride)) {
            for (x, seen) in (left..).zip(row[..plane.row_bytes].chunks_mut(3)) {
                seen.copy_from_slice(pixel(shot, x, y));
            }
        }
    }
    Ok(pattern::read(&Frame::parse(&frame)?.first()))
}

impl Site {
    fn start() -> Self {
        let dir = std::env::temp_dir().join(format!("ddx-browser-{}", std::process::id()));
        fs::create_dir_all(&dir).unwrap();
        let mut site = Self {
            dir,
            children: Vec::new(),
        };
        site.first_line(&["up", "--config", "/dev/null", "--host", "robot1"]);
        site
    }

    /// Starts a program that stays, and returns what it says first.
    fn first_line(&mut self, arguments: &[&str]) -> Value {
        let output = self.background(arguments);
        let mut line = String::new();
        BufReader::new(output).read_line(&mut line).unwrap();
        serde_json::from_str(&line).unwrap()
    }

    fn background(&mut self, arguments: &[&str]) -> ChildStdout {
        let mut child = Command::new(env!("CARGO_BIN_EXE_ddx"))
            .arg("--json")
            .args(arguments)
            .env("DDX_SOCKET", self.dir.join("ddx.sock"))
            .env("DDX_STATE_DIR", &self.dir)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let output = child.stdout.take().unwrap();
        self.children.insert(0, child);
        output
    }

    /// Opens a page and returns what Chromium prints then.
    fn browse(&self, url: &str, deed: &str) -> String {
        let output = Command::new(CHROMIUM)
            // Root has no sandbox, and what is shown here is our own.
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--no-first-run",
            ])
            .arg(format!("--user-data-dir={}", self.dir.display()))
            // Timers pass at once, but not while an answer is awaited.
            .args(["--window-size=1000,600", "--virtual-time-budget=5000"])
            .args([deed, url])
            .stdin(Stdio::null())
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{errors}");
        String::from_utf8_lossy(&output.stdout).into_owned()
    }

    /// What Chromium shows when one of the streams is chosen.
    fn shot(&self, url: &str, stream: &str) -> Rgb {
        let shown = Path::new(env!("CARGO_TARGET_TMPDIR")).with_file_name("browser");
        fs::create_dir_all(&shown).unwrap();
        let file = shown.join(format!("{stream}.png"));
        let url = format!("{url}#robot1%2F{stream}");
        self.browse(&url, &format!("--screenshot={}", file.display()));
        let mut decoder = png::Decoder::new(BufReader::new(File::open(&file).unwrap()));
        decoder.set_transformations(png::Transformations::normalize_to_color8());
        let mut reader = decoder.read_info().unwrap();
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut bytes).unwrap();
        let samples = info.color_type.samples();
        assert!(samples >= 3, "{info:?}");
        Rgb {
            width: info.width,
            height: info.height,
            bytes: bytes
                .chunks(samples)
                .flat_map(|pixel| &pixel[..3])
                .copied()
                .collect(),
        }
    }
}

impl Drop for Site {
    fn drop(&mut self) {
        for child in &mut self.children {
            // Fails only when it has ended.
            let _ended = child.kill();
            child.wait().unwrap();
        }
        // What Chromium started ends a moment after it, and may still write.
        wait("end of Chromium", || {
            fs::remove_dir_all(&self.dir).map_err(|fault| fault.to_string())
        });
    }
}

const CHROMIUM: &str = "chromium";
const CLIP: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/data/bunny.y4m");
/// Of the pattern.
const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;
/// Levels of 256.
const LOSSY: u32 = 8;
/// Chromium starts in a second, or in several on a loaded machine.
const PATIENCE: Duration = Duration::from_secs(30);
