//! Frames as a film: MP4 and WebM by `ffmpeg` where it is installed, GIF also without it.

use crate::Usage;
use anyhow::{Context, Result, anyhow, bail};
use irradia_runs::formats::folder_of;
use irradia_runs::scene::Image;
use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// Options of `ffmpeg` for each kind of film: container, codec and quality.
const ENCODERS: [(&str, &[&str]); 2] = [
    (
        "mp4",
        &[
            "-f",
            "mp4",
            "-c:v",
            "libx264",
            "-crf",
            "18",
            "-pix_fmt",
            "yuv420p",
            "-movflags",
            "+faststart",
        ],
    ),
    (
        "webm",
        &[
            "-f",
            "webm",
            "-c:v",
            "libvpx-vp9",
            "-crf",
            "24",
            "-b:v",
            "0",
            "-pix_fmt",
            "yuv420p",
        ],
    ),
];
/// How thoroughly the colours of a GIF's frame are chosen, 1 (best) to 30.
const GIF_SPEED: i32 = 10;

/// A film that is being written, under a temporary name until it is complete.
pub struct FilmWriter {
    path: PathBuf,
    unfinished: PathBuf,
    /// `None` once it has ended.
    encoder: Option<Encoder>,
}

enum Encoder {
    Ffmpeg(Child),
    Gif {
        encoder: Box<gif::Encoder<BufWriter<File>>>,
        fps: f32,
        /// Added so far.
        frames: u32,
        /// Those written, in hundredths of a second.
        written: u32,
    },
}

/// The kind of film that `path` names by its extension.
pub fn kind(path: &Path) -> Option<&'static str> {
    let extension = path.extension()?.to_str()?.to_ascii_lowercase();
    ["mp4", "webm", "gif"].into_iter().find(|kind| *kind == extension)
}

impl FilmWriter {
    /// Begins a film of frames with `width` x `height` pixels.
    pub fn begin(path: &Path, (width, height): (u32, u32), fps: f32) -> Result<Self> {
        let name = path.file_name().context("a film needs a file name")?.to_string_lossy();
        if path.is_dir() {
            // Renaming would fail after the last frame.
            return Err(Usage(format!(
                "{} is a folder: choose another name for the film",
                path.display()
            ))
            .into());
        }
        if let Some(folder) = folder_of(path) {
            fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
        }
        let unfinished = path.with_file_name(format!(".{name}.{}.tmp", std::process::id()));
        let encoder = match kind(path) {
            Some("gif") => gif_encoder(&unfinished, width, height, fps)?,
            Some(kind) => ffmpeg(&unfinished, kind, width, height, fps)?,
            None => return Err(Usage(format!("{}: a film must end in .mp4, .webm or .gif", path.display())).into()),
        };
        Ok(Self {
            path: path.to_owned(),
            unfinished,
            encoder: Some(encoder),
        })
    }

    /// Adds a frame.
    pub fn add(&mut self, image: &Image) -> Result<()> {
        let rgb = image.to_u8();
        match self.encoder.as_mut().context("the film has ended")? {
            Encoder::Ffmpeg(child) => {
                let input = child.stdin.as_mut().context("ffmpeg accepts no frames")?;
                // If ffmpeg ended early, `end` returns its reason.
                input
                    .write_all(&rgb)
                    .or_else(|error| self.end().and(Err(error).context("ffmpeg accepts no more frames")))
            }
            Encoder::Gif {
                encoder,
                fps,
                frames,
                written,
            } => {
                *frames += 1;
                // In whole hundredths of a second that add up to the film's length. Browsers slow down frames of less than two, so at
                // more than 50 frames a second, some are left out.
                let end = (100.0 * *frames as f32 / *fps).round() as u32;
                let delay = end.saturating_sub(*written);
                if delay < 2 && *frames > 1 {
                    return Ok(());
                }
                let delay = delay.max(2);
                *written += delay;
                let mut frame = gif::Frame::from_rgb_speed(image.width as u16, image.height as u16, &rgb, GIF_SPEED);
                frame.delay = delay.min(u16::MAX.into()) as u16;
                encoder
                    .write_frame(&frame)
                    .with_context(|| format!("cannot write {}", self.path.display()))
            }
        }
    }

    /// Completes the film.
    pub fn finish(mut self) -> Result<()> {
        self.end()?;
        fs::rename(&self.unfinished, &self.path).with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Ends the encoder, which writes what is left.
    fn end(&mut self) -> Result<()> {
        let unwritten = || format!("cannot write {}", self.path.display());
        match self.encoder.take() {
            Some(Encoder::Ffmpeg(mut child)) => {
                drop(child.stdin.take());
                let output = child.wait_with_output().context("ffmpeg")?;
                if !output.status.success() {
                    let said = String::from_utf8_lossy(&output.stderr);
                    let last = said.lines().last().unwrap_or("no reason given");
                    return Err(anyhow!("ffmpeg could not write {}: {last}", self.path.display()));
                }
            }
            Some(Encoder::Gif { encoder, .. }) => {
                let mut file = encoder.into_inner().with_context(unwritten)?;
                file.flush().with_context(unwritten)?;
            }
            None => {}
        }
        Ok(())
    }
}

impl Drop for FilmWriter {
    /// Removes what was not finished.
    fn drop(&mut self) {
        // Best effort: a finished film has another name by now.
        let _ = fs::remove_file(&self.unfinished);
    }
}

fn gif_encoder(path: &Path, width: u32, height: u32, fps: f32) -> Result<Encoder> {
    let file = File::create(path).with_context(|| format!("cannot create {}", path.display()))?;
    // Sides are at most 16384, see `parse_frame_size`.
    let mut encoder = gif::Encoder::new(BufWriter::new(file), width as u16, height as u16, &[])?;
    encoder.set_repeat(gif::Repeat::Infinite)?;
    Ok(Encoder::Gif {
        encoder: Box::new(encoder),
        fps,
        frames: 0,
        written: 0,
    })
}

fn ffmpeg(path: &Path, kind: &str, width: u32, height: u32, fps: f32) -> Result<Encoder> {
    let (_, options) = ENCODERS
        .iter()
        .find(|(known, _)| *known == kind)
        .context("a known kind")?;
    let mut command = Command::new("ffmpeg");
    command
        .args(["-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"])
        .args(["-s", &format!("{width}x{height}"), "-r", &fps.to_string(), "-i", "-"])
        // These codecs need even sides.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"])
        .args(*options)
        .arg(path)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    match command.spawn() {
        Ok(child) => Ok(Encoder::Ffmpeg(child)),
        Err(error) => bail!(
            "a .{kind} needs ffmpeg, which cannot be started ({error}): install it, or write a .gif or a folder of frames"
        ),
    }
}
