//! Selection of frames from films for posing: the sharpest frame of each window, where windows contain equal amounts of motion.

use super::PoseProgress;
use super::capture::prepare_folder;
use crate::{RunError, distinct};
use irradia_formats::write_atomic;
use irradia_sfm::Features;
use irradia_sfm::features::{Extractor, GreyPhoto, Sift};
use irradia_sfm::matching::{MatchOptions, match_features};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::fs;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// File extensions of films.
const FILM_EXTENSIONS: [&str; 12] = [
    "mp4", "mov", "m4v", "mkv", "webm", "avi", "mpg", "mpeg", "mts", "m2ts", "3gp", "wmv",
];
/// Minimum and maximum number of frames chosen from all films together, unless they have fewer.
const FRAME_COUNT_RANGE: [usize; 2] = [100, 300];
/// Motion between chosen frames, in frame widths: two thirds of a frame or more stay in view for several frames.
const FRAME_SPACING: f64 = 0.05;
/// Motion assigned to a frame with too few matches with the frame before, in frame widths.
const UNMATCHED_MOTION: f64 = 0.1;
/// Minimum number of frames from each film, if it has that many.
const MIN_FRAMES_PER_FILM: usize = 10;
/// Width of the frames in which motion and sharpness are measured, pixels.
const MEASURED_WIDTH: u32 = 320;
/// Number of frames that are measured in parallel.
const BATCH_FRAMES: usize = 32;
/// Maximum length of a line in the header of ffmpeg's grey images, bytes.
const MAX_HEADER_LINE_BYTES: usize = 64;
/// The exit code of ffmpeg after an interrupt.
const INTERRUPTED_EXIT_CODE: i32 = 255;

/// Whether `path` has the extension of a film.
pub fn is_film_name(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    extension.is_some_and(|e| FILM_EXTENSIONS.contains(&e.as_str()))
}

/// Whether `path` is a film by its extension.
pub(super) fn is_film(path: &Path) -> bool {
    is_film_name(path) && path.is_file()
}

/// Whether ffmpeg is installed.
pub(super) fn is_ffmpeg_installed() -> bool {
    ffmpeg_version().is_some()
}

/// The version text of ffmpeg, if it is installed.
fn ffmpeg_version() -> Option<String> {
    let output = Command::new("ffmpeg")
        .arg("-version")
        .stdin(Stdio::null())
        .output()
        .ok()?;
    let version = String::from_utf8_lossy(&output.stdout).into_owned();
    output.status.success().then_some(version)
}

/// The option that makes ffmpeg of this `version` pass every frame once: `-fps_mode` is new in 5.1, and later versions removed `-vsync`.
fn frame_option(version: &str) -> &'static str {
    let number = version.strip_prefix("ffmpeg version ").unwrap_or_default();
    let mut parts = number.trim_start_matches('n').split(['.', '-', ' ']);
    let mut part = || parts.next()?.parse::<u32>().ok();
    match part() {
        // Development builds do not have a version number.
        Some(major) if (major, part().unwrap_or(0)) < (5, 1) => "-vsync",
        _ => "-fps_mode",
    }
}

/// The record of the chosen frames, beside them; it is empty at first.
const RECORD_FILE: &str = "frames.json";

/// The frames chosen from a film, recorded so that a later call can reuse them.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct ChosenFrames {
    film: PathBuf,
    bytes: u64,
    modified: Option<std::time::SystemTime>,
    /// Prefix of the frames' names.
    stem: String,
    frames: Vec<usize>,
    /// Why the film provides no frames, or not all of its frames.
    #[serde(default)]
    damaged: Option<String>,
}

impl ChosenFrames {
    fn name(&self, frame: usize) -> String {
        format!("{}_{frame:06}.jpg", self.stem)
    }

    /// The film's file name and the reason, if it does not provide all of its frames.
    fn left_out(&self) -> Option<(String, String)> {
        let name = self.film.file_name().unwrap_or_default().to_string_lossy().into_owned();
        self.damaged.clone().map(|reason| (name, reason))
    }
}

/// Writes the chosen frames of `films` as JPEG into `folder`, unless an earlier call already did. Returns the films of which not all frames
/// can be read, and why; if none of the frames of one of the first `named` films can be read, that is an error.
pub(super) fn write_frames(
    films: &[PathBuf],
    named: usize,
    folder: &Path,
    progress: &(dyn Fn(PoseProgress) + Sync),
) -> Result<Vec<(String, String)>, RunError> {
    let record = folder.join(RECORD_FILE);
    let mut chosen = films
        .iter()
        .map(|film| empty_selection(film))
        .collect::<Result<Vec<_>, _>>()?;
    // Films in different folders may have the same name.
    let stems = distinct(chosen.iter().map(|chosen| chosen.stem.clone()));
    for (chosen, stem) in chosen.iter_mut().zip(stems) {
        chosen.stem = stem;
    }
    let known: Option<Vec<ChosenFrames>> = fs::read(&record)
        .ok()
        .and_then(|bytes| serde_json::from_slice(&bytes).ok());
    if let Some(known) = known.filter(|known| known.len() == chosen.len()) {
        for (chosen, known) in chosen.iter_mut().zip(&known) {
            chosen.frames.clone_from(&known.frames);
            chosen.damaged.clone_from(&known.damaged);
        }
        let mut names = chosen
            .iter()
            .flat_map(|film| film.frames.iter().map(|frame| film.name(*frame)));
        if known == chosen && names.all(|name| folder.join(name).is_file()) {
            return Ok(chosen.iter().filter_map(ChosenFrames::left_out).collect());
        }
    }
    progress(PoseProgress::Stage { name: "frames", of: 0 });
    let mut before = 0;
    let mut measured = Vec::new();
    for (i, film) in films.iter().enumerate() {
        let frames = match measure(film, before, progress) {
            Ok((frames, unread)) => {
                chosen[i].damaged = unread;
                frames
            }
            // Without ffmpeg, a film is not damaged: it can be read once ffmpeg is installed.
            Err(error) if i < named || !is_ffmpeg_installed() => return Err(error),
            Err(error) => {
                let message = error.to_string();
                let path = format!("{}: ", film.display());
                chosen[i].damaged = Some(message.strip_prefix(&path).unwrap_or(&message).to_owned());
                Vec::new()
            }
        };
        before += frames.len();
        measured.push(frames);
    }
    // Frames of an earlier selection must not be used as photographs.
    prepare_folder(folder, RECORD_FILE)?;
    for ((chosen, frames), wanted) in chosen.iter_mut().zip(&measured).zip(frame_counts(&measured)) {
        if !frames.is_empty() {
            chosen.frames = choose(frames, wanted);
            extract(chosen, folder)?;
        }
    }
    write_atomic(&record, |file| file.write_all(&crate::folder::to_json(&chosen)))?;
    Ok(chosen.iter().filter_map(ChosenFrames::left_out).collect())
}

/// A film without chosen frames.
fn empty_selection(film: &Path) -> Result<ChosenFrames, RunError> {
    let metadata = fs::metadata(film).map_err(RunError::io("read", film))?;
    Ok(ChosenFrames {
        film: std::path::absolute(film).unwrap_or_else(|_| film.to_owned()),
        bytes: metadata.len(),
        modified: metadata.modified().ok(),
        stem: film.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
        frames: Vec::new(),
        damaged: None,
    })
}

/// Number of frames to choose from each film: the total depends on the motion of all films and is distributed in proportion to the motion
/// of each.
fn frame_counts(films: &[Vec<Frame>]) -> Vec<usize> {
    let motion = |frames: &Vec<Frame>| frames.iter().map(|frame| frame.motion).sum::<f64>();
    let total: f64 = films.iter().map(motion).sum();
    let wanted = ((total / FRAME_SPACING) as usize).clamp(FRAME_COUNT_RANGE[0], FRAME_COUNT_RANGE[1]);
    let share = |frames: &Vec<Frame>| {
        if total > 0.0 {
            motion(frames) / total
        } else {
            // Cameras that stand still.
            1.0 / films.len() as f64
        }
    };
    let count = |frames| ((share(frames) * wanted as f64).round() as usize).max(MIN_FRAMES_PER_FILM);
    films.iter().map(count).collect()
}

/// Measurements of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Frame {
    /// Motion since the frame before, in frame widths.
    motion: f64,
    /// Mean square of the Laplacian.
    sharpness: f64,
}

/// Frames that can be read, and why others cannot, if there are any.
type Measured = (Vec<Frame>, Option<String>);

/// Measures all frames of a film, at a reduced size; `before` frames of other films have already been measured.
fn measure(film: &Path, before: usize, progress: &(dyn Fn(PoseProgress) + Sync)) -> Result<Measured, RunError> {
    let mut child = Command::new("ffmpeg")
        .args(["-loglevel", "error", "-i"])
        .arg(file_url(film))
        .args(["-vf", &format!("scale={MEASURED_WIDTH}:-2")])
        .args([frame_option(&ffmpeg_version().unwrap_or_default()), "passthrough"])
        .args(["-f", "image2pipe", "-c:v", "pgm", "-pix_fmt", "gray", "-"])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|error| no_ffmpeg(film, &error))?;
    let mut pictures = BufReader::with_capacity(1 << 20, child.stdout.take().expect("a pipe"));
    // Errors are read concurrently: a full pipe would block ffmpeg.
    let mut errors = child.stderr.take().expect("a pipe");
    let stderr_text = std::thread::spawn(move || {
        let mut stderr_text = String::new();
        // Best effort: it only explains a failure.
        let _ = errors.read_to_string(&mut stderr_text);
        stderr_text
    });
    let sift = Sift {
        max_features: 400,
        ..Sift::default()
    };
    let mut frames = Vec::new();
    let mut last: Option<Features> = None;
    loop {
        let batch: Vec<Picture> = std::iter::from_fn(|| read_picture(&mut pictures))
            .take(BATCH_FRAMES)
            .collect();
        if batch.is_empty() {
            break;
        }
        let seen: Vec<(Features, f64)> = batch
            .par_iter()
            .map(|picture| (sift.extract(&picture.photo()), picture.sharpness()))
            .collect();
        let earlier: Vec<Option<&Features>> = std::iter::once(last.as_ref())
            .chain(seen.iter().map(|(features, _)| Some(features)))
            .collect();
        let motions: Vec<f64> = seen
            .par_iter()
            .zip(&earlier)
            .map(|((features, _), earlier)| earlier.map_or(0.0, |earlier| motion(earlier, features)))
            .collect();
        frames.extend(motions.iter().zip(&seen).map(|(motion, (_, sharpness))| Frame {
            motion: *motion,
            sharpness: *sharpness,
        }));
        last = seen.into_iter().next_back().map(|(features, _)| features);
        progress(PoseProgress::Done(before + frames.len()));
    }
    // Where a frame could not be read, ffmpeg would wait forever for a reader.
    drop(pictures);
    let status = child.wait().map_err(RunError::io("read", film))?;
    let stderr_text = stderr_text.join().unwrap_or_default();
    // Killed or interrupted: the film may be sound.
    if status.code().is_none_or(|code| code == INTERRUPTED_EXIT_CODE) {
        return Err(unreadable(film, &stderr_text));
    }
    check_decoded(film, frames, (!status.success()).then_some(stderr_text.as_str()))
}

/// The frames that ffmpeg decoded. If it `failed`, with this text, others are damaged: ffmpeg leaves them out, and fails if they are most
/// of the film (its option `-max_error_rate`).
fn check_decoded(film: &Path, frames: Vec<Frame>, failed: Option<&str>) -> Result<Measured, RunError> {
    match failed {
        Some(stderr_text) if frames.is_empty() => Err(unreadable(film, stderr_text)),
        Some(stderr_text) => {
            let unread = format!(
                "frames that ffmpeg cannot read ({}); it reads the other {}",
                last_line(stderr_text),
                frames.len()
            );
            Ok((frames, Some(unread)))
        }
        None if frames.is_empty() => Err(RunError::Refused(format!("{}: the film has no frames", film.display()))),
        None => Ok((frames, None)),
    }
}

/// The URL of a film for ffmpeg; a plain file name might look like another protocol.
fn file_url(film: &Path) -> OsString {
    let mut url = OsString::from("file:");
    url.push(std::path::absolute(film).unwrap_or_else(|_| film.to_owned()));
    url
}

fn no_ffmpeg(film: &Path, error: &std::io::Error) -> RunError {
    RunError::Refused(format!(
        "{}: a film needs ffmpeg, which cannot be started ({error}): install it, or give a folder of photographs",
        film.display()
    ))
}

fn unreadable(film: &Path, stderr_text: &str) -> RunError {
    let reason = last_line(stderr_text);
    RunError::Refused(format!("{}: ffmpeg cannot read the film: {reason}", film.display()))
}

/// The reason that ffmpeg gives last.
fn last_line(stderr_text: &str) -> &str {
    stderr_text.lines().last().unwrap_or("no reason given")
}

/// A grey image.
struct Picture {
    width: u32,
    height: u32,
    data: Vec<u8>,
}

impl Picture {
    fn photo(&self) -> GreyPhoto<'_> {
        GreyPhoto {
            width: self.width,
            height: self.height,
            data: &self.data,
            mask: None,
        }
    }

    fn sharpness(&self) -> f64 {
        let (width, height) = (self.width as usize, self.height as usize);
        let at = |x: usize, y: usize| i64::from(self.data[y * width + x]);
        let mut sum = 0i64;
        for y in 1..height.saturating_sub(1) {
            for x in 1..width - 1 {
                let laplacian = at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1) - 4 * at(x, y);
                sum += laplacian * laplacian;
            }
        }
        sum as f64 / (width * height) as f64
    }
}

/// The next image of a stream of binary PGM; `None` at the end of the stream, or if the data are not an image by ffmpeg.
fn read_picture(stream: &mut impl Read) -> Option<Picture> {
    if read_line(stream)? != "P5" {
        return None;
    }
    let size = read_line(stream)?;
    let (width, height) = size.split_once(' ')?;
    let [width, height]: [u32; 2] = [width.parse().ok()?, height.parse().ok()?];
    if read_line(stream)? != "255" || width != MEASURED_WIDTH || height > 64 * MEASURED_WIDTH {
        return None;
    }
    let mut data = vec![0; width as usize * height as usize];
    stream.read_exact(&mut data).ok()?;
    Some(Picture { width, height, data })
}

fn read_line(stream: &mut impl Read) -> Option<String> {
    let mut line = Vec::new();
    loop {
        let mut byte = [0];
        stream.read_exact(&mut byte).ok()?;
        match byte[0] {
            b'\n' => return String::from_utf8(line).ok(),
            _ if line.len() == MAX_HEADER_LINE_BYTES => return None,
            other => line.push(other),
        }
    }
}

/// The median distance between matching features, in frame widths.
fn motion(before: &Features, after: &Features) -> f64 {
    let mut distances: Vec<f32> = match_features(before, after, &MatchOptions::default())
        .into_iter()
        .map(|[a, b]| {
            let (a, b) = (before.keypoints[a as usize], after.keypoints[b as usize]);
            (a.x - b.x).hypot(a.y - b.y)
        })
        .collect();
    if distances.len() < 8 {
        return UNMATCHED_MOTION;
    }
    distances.sort_by(f32::total_cmp);
    f64::from(distances[distances.len() / 2]) / f64::from(MEASURED_WIDTH)
}

/// The sharpest frame of each of `wanted` windows that are equal in motion.
fn choose(frames: &[Frame], wanted: usize) -> Vec<usize> {
    let total: f64 = frames.iter().map(|frame| frame.motion).sum();
    if frames.len() <= wanted {
        return (0..frames.len()).collect();
    }
    let mut best: Vec<Option<usize>> = vec![None; wanted];
    let mut moved = 0.0;
    for (i, frame) in frames.iter().enumerate() {
        moved += frame.motion;
        // Without motion, windows are equal in time.
        let at = if total > 0.0 {
            moved / total
        } else {
            i as f64 / frames.len() as f64
        };
        let slot = &mut best[((at * wanted as f64) as usize).min(wanted - 1)];
        if slot.is_none_or(|other| frames[other].sharpness < frame.sharpness) {
            *slot = Some(i);
        }
    }
    best.into_iter().flatten().collect()
}

/// The expression by which ffmpeg selects frames: a balanced sum, since it evaluates at most a hundred terms in a row.
fn selection_expression(frames: &[usize]) -> String {
    match frames {
        [] => "0".to_owned(),
        [frame] => format!("eq(n,{frame})"),
        several => {
            let (first, second) = several.split_at(several.len() / 2);
            format!("({}+{})", selection_expression(first), selection_expression(second))
        }
    }
}

/// Writes the chosen frames, which are in ascending order, under their names.
fn extract(chosen: &ChosenFrames, folder: &Path) -> Result<(), RunError> {
    let film = &chosen.film;
    let output = Command::new("ffmpeg")
        .args(["-loglevel", "error", "-y", "-i"])
        .arg(file_url(film))
        .args([
            "-vf",
            // Non-square pixels (DV, anamorphic) are made square: the cameras have one focal length.
            &format!("select='{}',scale=iw*sar:ih", selection_expression(&chosen.frames)),
        ])
        .args([frame_option(&ffmpeg_version().unwrap_or_default()), "passthrough"])
        // A relative pattern, since the path of the folder may contain a `%`.
        .args(["-q:v", "2", "-start_number", "0", "chosen_%06d.jpg"])
        .current_dir(folder)
        .stdin(Stdio::null())
        .output()
        .map_err(|error| no_ffmpeg(film, &error))?;
    let written = |i: usize| folder.join(format!("chosen_{i:06}.jpg"));
    // A film with damaged parts: ffmpeg fails, but has written the frames that can be read.
    if !output.status.success() && !(0..chosen.frames.len()).all(|i| written(i).is_file()) {
        return Err(unreadable(film, &String::from_utf8_lossy(&output.stderr)));
    }
    for (i, frame) in chosen.frames.iter().enumerate() {
        let (from, to) = (written(i), folder.join(chosen.name(*frame)));
        fs::rename(&from, &to).map_err(RunError::io("write", &to))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_ffmpeg_gets_an_option_that_it_knows() {
        for (version, option) in [
            ("ffmpeg version 4.4.2-0ubuntu0.22.04.1 Copyright", "-vsync"),
            ("ffmpeg version 5.0 Copyright", "-vsync"),
            ("ffmpeg version 5.1.6-0+deb12u1 Copyright", "-fps_mode"),
            ("ffmpeg version 7.0.2-static https", "-fps_mode"),
            ("ffmpeg version n4.3.1 Copyright", "-vsync"),
            ("ffmpeg version N-109516-g8e2a2e1 Copyright", "-fps_mode"),
            ("", "-fps_mode"),
        ] {
            assert_eq!(frame_option(version), option, "{version}");
        }
    }

    #[test]
    fn damaged_parts_of_a_film_do_not_cost_its_other_frames() {
        let frame = Frame {
            motion: 0.1,
            sharpness: 1.0,
        };
        let read = |frames: usize, failed| check_decoded("walk.mp4".as_ref(), vec![frame; frames], failed);
        let stderr_text = "moov\nInvalid data found";
        let (frames, unread) = read(7, Some(stderr_text)).unwrap();
        assert_eq!(frames.len(), 7);
        let unread = unread.unwrap();
        assert!(
            unread.contains("(Invalid data found)") && unread.contains("other 7"),
            "{unread}"
        );
        assert_eq!(read(7, None).unwrap().1, None);
        for (failed, reason) in [(Some(stderr_text), "Invalid data found"), (None, "no frames")] {
            let error = read(0, failed).unwrap_err().to_string();
            assert!(error.contains("walk.mp4") && error.contains(reason), "{error}");
        }
    }

    #[test]
    fn windows_are_equal_in_motion_and_give_their_sharpest_frame() {
        // A still half, then a moving one; every third frame is sharp.
        let frame = |i: usize| Frame {
            motion: if i < 300 { 0.0 } else { 0.05 },
            sharpness: if i % 3 == 1 { 2.0 } else { 1.0 },
        };
        let frames: Vec<Frame> = (0..900).map(frame).collect();
        let chosen = choose(&frames, 300);
        assert!((290..=300).contains(&chosen.len()), "{}", chosen.len());
        assert!(
            chosen.iter().filter(|i| **i < 300).count() <= 1,
            "one frame stands for the still half"
        );
        let sharp = chosen.iter().filter(|i| **i % 3 == 1).count();
        assert!(sharp * 3 > chosen.len(), "{sharp}");
        let still: Vec<Frame> = frames[..300].to_vec();
        assert_eq!(choose(&still, 100).len(), 100);
        assert_eq!(choose(&frames[..40], 100).len(), 40);
        // A moving film and a still one share the total.
        assert_eq!(frame_counts(&[frames, still.clone()]), [300, MIN_FRAMES_PER_FILM]);
        assert_eq!(frame_counts(&[still.clone(), still]), [50, 50]);
    }

    #[test]
    fn frames_are_selected_by_a_sum_that_is_nowhere_deep() {
        assert_eq!(selection_expression(&[3, 7, 9]), "(eq(n,3)+(eq(n,7)+eq(n,9)))");
        let frames: Vec<usize> = (0..300).map(|i| 3 * i).collect();
        let (mut depth, mut deepest) = (0usize, 0);
        let text = selection_expression(&frames);
        for c in text.chars() {
            match c {
                '(' => depth += 1,
                ')' => depth -= 1,
                _ => {}
            }
            deepest = deepest.max(depth);
        }
        assert!(depth == 0 && deepest <= 11, "{deepest}");
        assert_eq!(text.matches("eq(n,").count(), 300);
    }

    #[test]
    fn streams_that_are_not_pictures_end() {
        let mut stream: &[u8] = b"P5\n320 2\n255\n";
        assert!(read_picture(&mut stream).is_none());
        let mut whole = b"P5\n320 2\n255\n".to_vec();
        whole.extend([9; 640]);
        assert_eq!(
            read_picture(&mut &whole[..]).map(|picture| picture.data.len()),
            Some(640)
        );
        for junk in [
            &b"P6\n1 1\n255\nabc"[..],
            &[b'1'; 500],
            b"P5\n4294967295 4294967295\n255\n",
        ] {
            assert!(read_picture(&mut &junk[..]).is_none());
        }
    }
}
