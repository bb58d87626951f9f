//! The drawing thread: takes one task after another from the scheduler.

use crate::message::{Mode, PictureHeader, Shot, picture};
use crate::pace::Detail;
use crate::paint::{Painter, Picture};
use crate::scheduler::{DrawnPicture, SceneStatus, Scheduler, Task};
use crate::subject::{Edition, Subject};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use serde_json::json;
use std::time::Instant;

/// JPEG quality of a moving camera's pictures.
const MOVING_QUALITY: u8 = 75;
/// JPEG quality for a camera at rest: the loss is below what 8 bits show.
const SHARP_QUALITY: u8 = 96;
/// Bytes of splats copied per second, to estimate the time that a training loses by a copy.
const COPY_RATE: f32 = 1.5e9;

/// Draws until the scheduler closes.
pub(crate) fn draw(subject: &Subject, scheduler: &Scheduler) {
    let mut drawing = Drawing {
        subject,
        scheduler,
        painter: Painter::new(&subject.views),
        renewed: 0,
    };
    let status = || SceneStatus {
        version: subject.edition().map_or(0, |edition| edition.version),
        training: subject.live.as_ref().is_some_and(|live| live.is_training()),
    };
    while let Some((client, task)) = scheduler.next(status) {
        let Some(edition) = subject.edition() else { continue };
        match task {
            Task::Picture { shot, detail } => drawing.draw_picture(&edition, client, &shot, detail),
            Task::Pick { x, y, tag, shot } => {
                if let Some(shot) = shot.check() {
                    let picked = drawing.painter.pick(&edition, &shot, x, y, tag);
                    let mut message = serde_json::to_value(&picked).expect("plain data");
                    message["tell"] = "picked".into();
                    scheduler.send_text(client, message.to_string());
                }
            }
            Task::Score { view } => {
                let psnr = drawing.painter.score(&edition, view);
                let message = json!({ "tell": "score", "view": view, "psnr": psnr, "step": edition.step() });
                scheduler.send_text(client, message.to_string());
            }
        }
    }
}

/// The state of the drawing thread.
struct Drawing<'a> {
    subject: &'a Subject,
    scheduler: &'a Scheduler,
    painter: Painter<'a>,
    /// The version whose successor has been requested.
    renewed: u64,
}

impl Drawing<'_> {
    /// Reads the photograph of a view, and tells the page why it cannot be. Returns whether there is one.
    fn read_photo(&mut self, client: u64, view: Option<usize>) -> bool {
        let read = view.map_or(Ok(false), |view| self.painter.read_photo(view));
        read.unwrap_or_else(|error| {
            let message = json!({ "tell": "problem", "text": error.to_string() });
            self.scheduler.send_text(client, message.to_string());
            false
        })
    }

    fn draw_picture(&mut self, edition: &Edition, client: u64, shot: &Shot, detail: Detail) {
        let (subject, scheduler) = (self.subject, self.scheduler);
        let opened = Instant::now();
        self.painter.prepare(edition, shot, &detail);
        // Work that is done once per version is not part of a picture's cost.
        let started = Instant::now();
        let mut shot_drawn = *shot;
        if shot.mode == Mode::Error && !self.read_photo(client, shot.view) {
            // Without a photograph there are no errors: colours are drawn instead.
            shot_drawn.mode = Mode::Color;
        }
        let wanted = || scheduler.is_current(client, shot);
        let Some(drawn) = self.painter.paint(edition, &shot_drawn, &detail, &wanted) else {
            return;
        };
        let jpeg = to_jpeg(&drawn, if detail.sharp { SHARP_QUALITY } else { MOVING_QUALITY });
        let seconds = started.elapsed().as_secs_f32();
        let header = PictureHeader {
            id: shot.id,
            width: drawn.width,
            height: drawn.height,
            sharp: detail.sharp,
            version: edition.version,
            milliseconds: 1e3 * seconds,
            range: drawn.range,
        };
        scheduler.deliver(
            client,
            DrawnPicture {
                id: shot.id,
                version: edition.version,
                detail,
                pixels: drawn.width as f32 * drawn.height as f32,
                seconds,
                bytes: picture(&header, &jpeg),
            },
        );
        if let Some(live) = &subject.live {
            let seconds = opened.elapsed().as_secs_f32();
            if detail.moving {
                scheduler.pause_drawing(seconds);
            }
            if self.renewed < edition.version {
                self.renewed = edition.version;
                let copied = edition.scene().model.splats().map_or(0, |splats| splats.bytes());
                live.set_due(scheduler.schedule_renewal(seconds, copied as f32 / COPY_RATE));
            }
        }
    }
}

/// A JPEG with colour at full resolution: splats are often a few pixels wide.
pub(crate) fn to_jpeg(picture: &Picture, quality: u8) -> Vec<u8> {
    encode(&picture.rgb, picture.width, picture.height, quality)
}

/// `rgb [H, W, 3]` as a JPEG.
pub(crate) fn encode(rgb: &[u8], width: u32, height: u32, quality: u8) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, quality);
    encoder.set_sampling_factor(SamplingFactor::F_1_1);
    encoder
        .encode(rgb, width as u16, height as u16, ColorType::Rgb)
        .expect("sides are below 65,536, and a Vec takes every byte");
    bytes
}
