//! Motion of cameras while their photographs were read out: from `transforms.json`, or from the poses of neighbouring frames of a film.

use super::declared::{DeclaredPose, DeclaredView};
use glam::DVec3;
use irradia_scene::{FirstSide, RollingShutter};
use std::collections::BTreeMap;
use std::fmt;
use std::ops::Bound::{Excluded, Unbounded};
use std::path::Path;
use std::str::FromStr;

/// A velocity; numbers that are not finite are `None`.
pub(super) type Velocity = [Option<f64>; 3];

/// The rolling shutter of a film's camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Readout {
    /// The time from the first row to the last, in frames of the film: at 30 frames per second, 10 ms are 0.3.
    pub frames: f64,
    /// The side at which it begins.
    pub first: FirstSide,
}

impl fmt::Display for Readout {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}:{}", self.frames, self.first)
    }
}

impl FromStr for Readout {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (frames, first) = text.split_once(':').unwrap_or((text, "top"));
        let frames: Option<f64> = frames.parse().ok();
        let frames = frames.filter(|frames| (0.0..=1.0).contains(frames));
        Ok(Self {
            frames: frames
                .ok_or("expected 0 to 1 frames, such as 0.5, or 0.5:left if the left side is exposed first")?,
            first: first.parse()?,
        })
    }
}

/// The shutter from velocities in OpenGL axes, per second, and the time of a readout from top to bottom, seconds: the keys of "Gaussian
/// Splatting on the Move". `None` for a camera at rest, and for one that rotates so far that velocity or time must be in another unit.
pub(super) fn shutter_from_velocities(linear: Velocity, angular: Velocity, seconds: f64) -> Option<RollingShutter> {
    let opencv = |[x, y, z]: Velocity| Some((DVec3::new(x?, -y?, -z?) * seconds).as_vec3());
    let (translation, rotation) = (opencv(linear)?, opencv(angular)?);
    let is_moving = translation.is_finite()
        && rotation.length() <= RollingShutter::MOST_TURNED
        && (translation, rotation) != Default::default();
    is_moving.then_some(RollingShutter {
        first: FirstSide::Top,
        translation,
        rotation,
    })
}

/// Gives the frames of films, which are numbered by time, shutters from the poses of their neighbours. Frames that have a shutter keep it,
/// and frames that would rotate too far get none. Returns how many views have one.
pub(super) fn estimate_shutters(views: &mut [DeclaredView], readout: &Readout) -> usize {
    let mut films: BTreeMap<String, BTreeMap<u64, usize>> = BTreeMap::new();
    for (index, view) in views.iter().enumerate().filter(|(_, view)| view.pose.is_some()) {
        if let Some((film, number)) = film_and_number(&view.name) {
            films.entry(film).or_default().insert(number, index);
        }
    }
    for frames in films.values() {
        for (number, index) in frames {
            let before = frames.range(..number).next_back().unwrap_or((number, index));
            let after = frames.range((Excluded(number), Unbounded)).next();
            let after = after.unwrap_or((number, index));
            if before == after || readout.frames == 0.0 || views[*index].shutter.is_some() {
                continue;
            }
            let pose = |at: usize| views[at].pose.expect("those of films are posed");
            let motion = relative_motion(&pose(*index), &pose(*before.1), &pose(*after.1));
            let per_readout = readout.frames / (after.0 - before.0) as f64;
            let [translation, rotation] = motion.map(|motion| (motion * per_readout).as_vec3());
            if rotation.length() > RollingShutter::MOST_TURNED {
                continue;
            }
            views[*index].shutter = Some(RollingShutter {
                first: readout.first,
                translation,
                rotation,
            });
        }
    }
    views.iter().filter(|view| view.shutter.is_some()).count()
}

/// Translation and rotation from `before` to `after`, along and about the axes of `camera`.
fn relative_motion(camera: &DeclaredPose, before: &DeclaredPose, after: &DeclaredPose) -> [DVec3; 2] {
    let rotation = before.rotation.inverse() * after.rotation;
    let shortest = if rotation.w < 0.0 { -rotation } else { rotation };
    [
        camera.rotation.inverse() * (after.position - before.position),
        shortest.to_scaled_axis(),
    ]
}

/// The part of a frame's name that its film's frames have in common, and its number: the digits at the end of its stem.
fn film_and_number(name: &str) -> Option<(String, u64)> {
    let path = Path::new(name);
    let stem = path.file_stem()?.to_str()?;
    let digits_start = stem.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    let (film, number) = stem.split_at(digits_start);
    Some((format!("{}/{film}", path.parent()?.display()), number.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use super::super::declared::DeclaredCamera;
    use super::*;
    use glam::DQuat;

    #[test]
    fn text_is_read_as_it_is_written_and_nonsense_is_not() {
        for text in ["0.5:left", "0.25:top", "1:right", "0:bottom"] {
            assert_eq!(
                text.parse::<Readout>().map(|readout| readout.to_string()),
                Ok(text.into())
            );
        }
        assert_eq!(
            "0.5".parse::<Readout>().map(|readout| readout.first),
            Ok(FirstSide::Top)
        );
        for text in ["", "left", "0.5:up", "-0.1", "1.5", "NaN", "0.5:"] {
            assert!(text.parse::<Readout>().is_err(), "{text}");
        }
    }

    #[test]
    fn frames_move_as_their_neighbours_say() {
        // One unit sideways and 0.1 radians about Y per frame.
        let view = |name: &str, time: f64| {
            let pose = DeclaredPose {
                rotation: DQuat::from_rotation_y(0.1 * time),
                position: DVec3::new(time, 0.0, 0.0),
            };
            DeclaredView::posed(Path::new("."), name, None, Some(pose), DeclaredCamera::panorama())
        };
        let mut views = vec![
            view("a/film_010.jpg", 0.0),
            view("a/film_012.jpg", 2.0),
            view("a/film_016.jpg", 6.0),
            view("a/other_013.jpg", 50.0),
            view("a/name.jpg", 60.0),
            view("b/film_013.jpg", 70.0),
        ];
        let readout = "0.5:right".parse().expect("a readout");
        assert_eq!(estimate_shutters(&mut views, &readout), 3);
        for (view, angle) in views.iter().zip([0.0f64, 0.2, 0.6]) {
            let shutter = view.shutter.expect("it has neighbours");
            let along = DVec3::new(0.5 * angle.cos(), 0.0, 0.5 * angle.sin());
            assert!(shutter.translation.as_dvec3().distance(along) < 1e-6, "{shutter:?}");
            assert!(
                shutter.rotation.as_dvec3().distance(0.05 * DVec3::Y) < 1e-6,
                "{shutter:?}"
            );
            assert_eq!(shutter.first, FirstSide::Right);
        }
        assert!(views[3..].iter().all(|view| view.shutter.is_none()));
    }
}
