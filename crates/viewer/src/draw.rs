//! The drawing thread: takes one task after another from the scheduler.

use crate::message::{PictureHeader, Shot, picture};
use crate::pace::Detail;
use crate::paint::{Painter, Picture};
use crate::scheduler::{SceneStatus, Scheduler, Task};
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
    let mut painter = Painter::default();
    // The version whose successor has been requested.
    let mut renewed = 0;
    let now = || SceneStatus {
        version: subject.edition().map_or(0, |edition| edition.version),
        training: subject.live.as_ref().is_some_and(|live| live.is_training()),
    };
    while let Some((client, task)) = scheduler.next(now) {
        let Some(edition) = subject.edition() else { continue };
        match task {
            Task::Picture { shot, detail } => {
                draw_picture(
                    subject,
                    scheduler,
                    &mut painter,
                    &edition,
                    client,
                    &shot,
                    detail,
                    &mut renewed,
                );
            }
            Task::Pick { x, y, tag, shot } => {
                if let Some(shot) = shot.check() {
                    let picked = painter.pick(&edition, &shot, x, y, tag);
                    let mut message = serde_json::to_value(&picked).expect("plain data");
                    message["tell"] = "picked".into();
                    scheduler.send_text(client, message.to_string());
                }
            }
            Task::Score { view } => {
                let psnr = painter.score(&edition, view, &subject.views.0[view]);
                let message = json!({ "tell": "score", "view": view, "psnr": psnr, "step": edition.step() });
                scheduler.send_text(client, message.to_string());
            }
        }
    }
}

fn draw_picture(
    subject: &Subject,
    scheduler: &Scheduler,
    painter: &mut Painter,
    edition: &Edition,
    client: u64,
    shot: &Shot,
    detail: Detail,
    renewed: &mut u64,
) {
    let opened = Instant::now();
    painter.prepare(edition, shot, &detail);
    // Work that is done once per version is not part of a picture's cost.
    let started = Instant::now();
    let k = shot.camera.intrinsics.scaled(detail.pixels.sqrt());
    let view = shot.view.and_then(|view| subject.views.0.get(view));
    // Its photograph may be missing: then colours are drawn instead of errors.
    let shot_drawn = match view.is_some_and(|view| view.photo.is_some()) {
        true => *shot,
        false => Shot {
            mode: if shot.mode == crate::message::Mode::Error {
                Default::default()
            } else {
                shot.mode
            },
            ..*shot
        },
    };
    let wanted = || scheduler.is_current(client, shot);
    let Some(drawn) = painter.paint(edition, &shot_drawn, &detail, (k.width, k.height), view, &wanted) else {
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
    let pixels = drawn.width as f32 * drawn.height as f32;
    let bytes = picture(&header, &jpeg);
    scheduler.deliver(client, shot, detail, bytes, pixels, seconds, edition.version);
    if let Some(live) = &subject.live {
        let seconds = opened.elapsed().as_secs_f32();
        if detail.moving {
            scheduler.pause_drawing(seconds);
        }
        if *renewed < edition.version {
            *renewed = edition.version;
            let copied = edition.scene().model.splats().map_or(0, |splats| splats.bytes());
            live.set_due(scheduler.schedule_renewal(seconds, copied as f32 / COPY_RATE));
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
