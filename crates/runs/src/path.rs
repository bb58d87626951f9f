//! Camera paths: key frames with smooth interpolation between them, and ready-made paths around a scene. The viewer's page has a
//! twin (`crates/viewer/page/js/path.js`), which saves the files that are read here. Files are in the coordinates of the photographs, so
//! that they fit a scene however edits have moved it as a whole.
//!
//! Positions and fields of view follow a Catmull-Rom spline whose tangents are the differences of the neighbouring keys divided by those
//! of their times; rotations are interpolated by squad (Shoemake, "Quaternion calculus and fast animation", 1987).

use crate::{RunError, Scene};
use glam::{DVec3, Mat3, Quat, Vec3};
use irradia_edit::Transform;
use irradia_scene::{Camera, Intrinsics, Pose};
use serde::{Deserialize, Serialize};
use std::f32::consts::TAU;
use std::fs;
use std::path::Path;

/// Maximum number of frames of a path, and the error beyond it.
const MAX_FRAMES: usize = 100_000;
const TOO_MANY_FRAMES: &str = "it has more than 100,000 frames";
/// The mean position of the training cameras counts as inside the scene if it is closer to the centre than this fraction of their
/// distance; that of half a ring is at 0.64.
const INSIDE_FRACTION: f32 = 0.5;
/// How far a spiral may move towards the scene's centre, as a fraction of the distance between them: the mean of cameras half around a
/// scene is close to the subject.
const MAX_APPROACH_FRACTION: f32 = 0.3;
/// How far a spiral all around a scene rises and falls, in units of its radius.
const RISE_FRACTION: f32 = 0.3;
/// Range of frames per second.
const FPS_RANGE: std::ops::RangeInclusive<f32> = 0.1..=240.0;
/// Range of the width and height of a frame, pixels.
pub const FRAME_SIDE: std::ops::RangeInclusive<u32> = 1..=16384;

/// A camera at a point in time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PathKey {
    /// Seconds from the start.
    pub time: f32,
    /// Camera centre, world; in a file in the coordinates of the photographs.
    pub position: [f64; 3],
    /// World from camera (x right, y down, z forward): w, x, y, z.
    pub rotation: [f32; 4],
    /// Vertical field of view, radians.
    pub fov: f32,
}

/// Key frames in the order of their times, the first at 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraPath {
    /// Version of the file, 1.
    irradia_path: u32,
    /// Frames per second.
    pub fps: f32,
    /// Whether the last key is followed by the first one.
    #[serde(rename = "loop")]
    pub loops: bool,
    /// Whether the path starts and ends slowly; ignored for a loop.
    pub ease: bool,
    /// Seconds from the last key back to the first one in a loop.
    pub closing: f32,
    /// The key frames, at least one.
    pub keys: Vec<PathKey>,
}

/// A camera-path file of nerfstudio: a camera per frame.
#[derive(Deserialize)]
struct Nerfstudio {
    #[serde(default)]
    fps: Option<f32>,
    #[serde(default)]
    camera_type: Option<String>,
    #[serde(default)]
    render_width: Option<u32>,
    #[serde(default)]
    render_height: Option<u32>,
    camera_path: Vec<NerfstudioCamera>,
}

#[derive(Deserialize)]
struct NerfstudioCamera {
    /// Row-major 4 x 4, OpenGL's axes (x right, y up, z backward).
    camera_to_world: Vec<f64>,
    /// Vertical field of view, degrees.
    fov: f32,
}

/// The camera of every frame, and frames per second.
#[derive(Clone, Debug, PartialEq)]
pub struct Film {
    /// The cameras, in order.
    pub cameras: Vec<Camera>,
    /// Frames per second.
    pub fps: f32,
}

impl Film {
    /// Reads a path saved by the viewer, or a `camera_path.json` of nerfstudio. Both are in the coordinates of the photographs, provided that
    /// nerfstudio kept these. `world_from_photographs` maps them to the scene's world, also if the whole scene was moved
    /// ([`moved_from_run`](crate::moved_from_run)). Width and height of the frames, pixels, are `size`, otherwise those in the file,
    /// otherwise `default_size`.
    ///
    /// # Errors
    /// When the file cannot be read, or is not a path of pinhole cameras.
    pub fn read(
        path: &Path,
        world_from_photographs: &Transform,
        size: Option<(u32, u32)>,
        default_size: (u32, u32),
    ) -> Result<Self, RunError> {
        let text = fs::read_to_string(path).map_err(RunError::io("read", path))?;
        let wrong = |reason: &str| RunError::Damaged {
            path: path.to_owned(),
            reason: reason.to_owned(),
        };
        let value: serde_json::Value =
            serde_json::from_str(&text).map_err(|error| wrong(&format!("not a camera path: {error}")))?;
        if value.get("camera_path").is_some() {
            let file: Nerfstudio = serde_json::from_value(value).map_err(|error| wrong(&error.to_string()))?;
            if file.camera_path.is_empty() {
                return Err(wrong("the camera path has no frames"));
            }
            if file.camera_path.len() > MAX_FRAMES {
                return Err(wrong(TOO_MANY_FRAMES));
            }
            let camera_type = file.camera_type.as_deref().unwrap_or("perspective");
            if !camera_type.eq_ignore_ascii_case("perspective") {
                return Err(wrong(&format!(
                    "its cameras are of the type {camera_type}; only perspective ones are rendered"
                )));
            }
            let in_file = file.render_width.zip(file.render_height);
            let in_file = in_file.filter(|(w, h)| FRAME_SIDE.contains(w) && FRAME_SIDE.contains(h));
            let (width, height) = size.or(in_file).unwrap_or(default_size);
            let cameras: Option<Vec<Camera>> = file
                .camera_path
                .iter()
                .map(|c| c.camera(world_from_photographs, width, height))
                .collect();
            return Ok(Self {
                cameras: cameras.ok_or_else(|| wrong("a camera of the path has no valid pose or field of view"))?,
                fps: file.fps.filter(|fps| FPS_RANGE.contains(fps)).unwrap_or(30.0),
            });
        }
        let mut path: CameraPath =
            serde_json::from_value(value).map_err(|error| wrong(&format!("not a camera path: {error}")))?;
        path.keys.iter_mut().for_each(|key| key.move_by(world_from_photographs));
        path.check().map_err(wrong)?;
        Ok(path.film(size.unwrap_or(default_size)))
    }

    /// `frames` cameras on a circle around the scene.
    pub fn orbit(scene: &Scene, frames: u32, size: Option<(u32, u32)>) -> Self {
        Self {
            cameras: scene.orbit(frames, size),
            fps: 30.0,
        }
    }

    /// `frames` cameras on two turns of an elliptic spiral about the training cameras' mean position, looking at the scene's centre: the
    /// path of LLFF (Mildenhall et al. 2019) for forward-facing captures. If the cameras are all around the scene, their mean is inside it,
    /// and the path is two turns of an orbit that rises and falls.
    pub fn spiral(scene: &Scene, frames: u32, size: Option<(u32, u32)>) -> Self {
        let orbit_geometry = scene.orbit_geometry();
        let around = scene.orbit(32, None);
        let cameras = scene
            .cameras
            .as_deref()
            .filter(|cameras| cameras.len() > 1)
            .unwrap_or(&around);
        let center = cameras.iter().map(|c| c.pose.position).sum::<Vec3>() / cameras.len() as f32;
        let pose = Pose::look_at(center, orbit_geometry.center, orbit_geometry.up);
        // The 90th percentile of the cameras' offsets along each axis of the mean camera.
        let radius = |axis: Vec3| {
            let axis = pose.rotation * axis;
            let mut offsets: Vec<f32> = cameras
                .iter()
                .map(|c| (c.pose.position - center).dot(axis).abs())
                .collect();
            offsets.sort_unstable_by(f32::total_cmp);
            offsets[(offsets.len() * 9 / 10).min(offsets.len() - 1)]
        };
        if center.distance(orbit_geometry.center) < INSIDE_FRACTION * orbit_geometry.radius.hypot(orbit_geometry.height)
        {
            return Self::rising_orbit(scene, frames, size);
        }
        let mut radii = Vec3::new(radius(Vec3::X), radius(Vec3::Y), radius(Vec3::Z)) * 0.7;
        radii.z = radii
            .z
            .min(MAX_APPROACH_FRACTION * center.distance(orbit_geometry.center));
        let intrinsics = resized_intrinsics(orbit_geometry.intrinsics, size);
        let camera = |i: u32| {
            let angle = 2.0 * TAU * i as f32 / frames as f32;
            let offset = Vec3::new(angle.cos(), -angle.sin(), -(0.5 * angle).sin()) * radii;
            let eye = center + pose.rotation * offset;
            Camera::new(Pose::look_at(eye, orbit_geometry.center, orbit_geometry.up), intrinsics)
        };
        Self {
            cameras: (0..frames).map(camera).collect(),
            fps: 30.0,
        }
    }

    /// `frames` cameras on two turns of a rising and falling orbit, or on its arc.
    fn rising_orbit(scene: &Scene, frames: u32, size: Option<(u32, u32)>) -> Self {
        let orbit_geometry = scene.orbit_geometry();
        let turn = scene.orbit(frames.div_ceil(2), size);
        let camera = |(i, camera): (u32, &Camera)| {
            let rise = RISE_FRACTION * orbit_geometry.radius * (TAU * i as f32 / frames as f32).sin();
            let eye = camera.pose.position + rise * orbit_geometry.up;
            Camera::new(
                Pose::look_at(eye, orbit_geometry.center, orbit_geometry.up),
                camera.intrinsics,
            )
        };
        Self {
            cameras: (0..frames).zip(turn.iter().cycle()).map(camera).collect(),
            fps: 30.0,
        }
    }

    /// `frames` cameras on a smooth loop through the training cameras; `None` if there are none. They follow the `names` of their views
    /// ([`camera_names`](crate::camera_names)), in which numbers count as numbers: `r_2` comes before `r_10`.
    pub fn training(scene: &Scene, names: &[String], frames: u32, size: Option<(u32, u32)>) -> Option<Self> {
        let cameras = scene.cameras.as_deref().filter(|cameras| !cameras.is_empty())?;
        let mut order: Vec<usize> = (0..cameras.len()).collect();
        if names.len() == cameras.len() {
            order.sort_by_cached_key(|i| natural_key(&names[*i]));
        }
        let cameras: Vec<&Camera> = order.into_iter().map(|i| &cameras[i]).collect();
        let key = |(i, camera): (usize, &Camera)| {
            let (k, q) = (&camera.intrinsics, camera.pose.rotation);
            PathKey {
                time: i as f32,
                position: camera.pose.position.as_dvec3().to_array(),
                rotation: [q.w, q.x, q.y, q.z],
                fov: 2.0 * (0.5 * k.height as f32 / k.fy).atan(),
            }
        };
        let path = CameraPath {
            irradia_path: 1,
            fps: 30.0,
            loops: true,
            ease: false,
            closing: 1.0,
            keys: cameras.iter().copied().enumerate().map(key).collect(),
        };
        let (width, height) = size.unwrap_or((cameras[0].intrinsics.width, cameras[0].intrinsics.height));
        let at = |i: u32| path.camera(path.seconds() * i as f32 / frames as f32, width, height);
        Some(Self {
            cameras: (0..frames).map(at).collect(),
            fps: path.fps,
        })
    }
}

/// A key by which names are sorted with their numbers as numbers: text, number of digits and digits, as often as the name has numbers.
fn natural_key(mut name: &str) -> Vec<(&str, usize, &str)> {
    let mut parts = Vec::new();
    while !name.is_empty() {
        let (text, rest) = name.split_at(name.find(|c: char| c.is_ascii_digit()).unwrap_or(name.len()));
        let (digits, after) = rest.split_at(rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len()));
        let digits = digits.trim_start_matches('0');
        parts.push((text, digits.len(), digits));
        name = after;
    }
    parts
}

/// Intrinsics of another size with the same horizontal field of view.
fn resized_intrinsics(k: Intrinsics, size: Option<(u32, u32)>) -> Intrinsics {
    size.map_or(k, |(width, height)| {
        Intrinsics::from_fov_x(width, height, 2.0 * (0.5 * k.width as f32 / k.fx).atan())
    })
}

impl PathKey {
    fn move_by(&mut self, transform: &Transform) {
        let [w, x, y, z] = self.rotation;
        let rotation = transform.rotation.as_quat() * Quat::from_xyzw(x, y, z, w);
        self.rotation = [rotation.w, rotation.x, rotation.y, rotation.z];
        self.position = transform.apply(self.position.into()).to_array();
    }
}

impl NerfstudioCamera {
    fn camera(&self, world_from_photographs: &Transform, width: u32, height: u32) -> Option<Camera> {
        let m = &self.camera_to_world;
        if m.len() < 12 || m.iter().any(|v| !v.is_finite()) || !(self.fov > 0.0 && self.fov < 180.0) {
            return None;
        }
        let column = |c: usize| DVec3::new(m[c], m[4 + c], m[8 + c]);
        let [x, y, z] = [column(0), -column(1), -column(2)].map(|axis| axis.normalize_or_zero().as_vec3());
        let pose = Pose {
            rotation: (world_from_photographs.rotation.as_quat() * Quat::from_mat3(&Mat3::from_cols(x, y, z)))
                .normalize(),
            position: world_from_photographs.apply(column(3)).as_vec3(),
        };
        pose.is_valid()
            .then(|| camera_with_fov(pose, self.fov.to_radians(), width, height))
    }
}

/// A camera with square pixels and a vertical field of view.
fn camera_with_fov(pose: Pose, fov: f32, width: u32, height: u32) -> Camera {
    let mut k = Intrinsics::from_fov_x(width, height, 1.0);
    let focal = 0.5 * height as f32 / (0.5 * fov).tan();
    (k.fx, k.fy) = (focal, focal);
    Camera::new(pose, k)
}

impl CameraPath {
    /// Checks the path; the error says what is wrong.
    fn check(&self) -> Result<(), &'static str> {
        let finite = |key: &PathKey| {
            let position = key.position.map(|v| v as f32);
            let numbers = [key.time, key.fov].into_iter().chain(position).chain(key.rotation);
            numbers.into_iter().all(f32::is_finite) && key.rotation.iter().any(|v| *v != 0.0)
        };
        if self.irradia_path != 1 {
            return Err("unknown version of the camera path format");
        }
        if self.keys.is_empty() || !self.keys.iter().all(finite) {
            return Err("there are no key frames, or one has no valid pose");
        }
        if !self
            .keys
            .iter()
            .all(|key| key.fov > 0.0 && key.fov < std::f32::consts::PI)
        {
            return Err("a field of view must be above 0 and below pi");
        }
        if self.keys[0].time != 0.0 || self.keys.windows(2).any(|pair| pair[0].time > pair[1].time) {
            return Err("the times of key frames must start at 0 and not decrease");
        }
        if !FPS_RANGE.contains(&self.fps) || !(0.0..1e6).contains(&self.closing) {
            return Err("frames per second must be 0.1 to 240, and closing 0 to 1,000,000 seconds");
        }
        if self.seconds() * self.fps > MAX_FRAMES as f32 {
            return Err(TOO_MANY_FRAMES);
        }
        Ok(())
    }

    /// Length in seconds.
    pub fn seconds(&self) -> f32 {
        let last = self.keys.last().map_or(0.0, |key| key.time);
        last + if self.loops && self.keys.len() > 1 {
            self.closing
        } else {
            0.0
        }
    }

    /// All frames; the last frame of a loop leads back to the first.
    fn film(&self, (width, height): (u32, u32)) -> Film {
        let steps = (self.seconds() * self.fps).round() as usize;
        let frames = if self.loops { steps.max(1) } else { steps + 1 };
        Film {
            cameras: (0..frames)
                .map(|i| self.camera(i as f32 / self.fps, width, height))
                .collect(),
            fps: self.fps,
        }
    }

    /// The camera after `seconds`, with frames of `width` x `height` pixels.
    pub fn camera(&self, seconds: f32, width: u32, height: u32) -> Camera {
        let PathKey {
            position,
            rotation,
            fov,
            ..
        } = self.at(seconds);
        let [w, x, y, z] = rotation;
        let pose = Pose {
            rotation: Quat::from_xyzw(x, y, z, w).normalize(),
            position: DVec3::from(position).as_vec3(),
        };
        camera_with_fov(pose, fov, width, height)
    }

    /// The interpolated key after `seconds`.
    pub fn at(&self, seconds: f32) -> PathKey {
        let (keys, n) = (&self.keys, self.keys.len() as isize);
        if n == 1 {
            return keys[0];
        }
        let total = self.seconds();
        let along = seconds.clamp(0.0, total) / total.max(1e-9);
        let eased = if self.ease && !self.loops {
            along * along * (3.0 - 2.0 * along)
        } else {
            along
        };
        let time = eased * total;
        let mut i = keys.partition_point(|key| key.time <= time) as isize - 1;
        i = if self.loops { i.max(0) } else { i.clamp(0, n - 2) };
        let key = |j: isize| -> PathKey {
            if !self.loops {
                return keys[j.clamp(0, n - 1) as usize];
            }
            let mut key = keys[j.rem_euclid(n) as usize];
            key.time += j.div_euclid(n) as f32 * total;
            key
        };
        let [k0, k1, k2, k3] = [key(i - 1), key(i), key(i + 1), key(i + 2)];
        let span = (k2.time - k1.time).max(1e-9);
        let t = ((time - k1.time) / span).clamp(0.0, 1.0);
        let spline = |value: &dyn Fn(&PathKey) -> f64| {
            let [p0, p1, p2, p3] = [&k0, &k1, &k2, &k3].map(value);
            let [t, span] = [t, span].map(f64::from);
            let m1 = span * (p2 - p0) / f64::from((k2.time - k0.time).max(1e-9));
            let m2 = span * (p3 - p1) / f64::from((k3.time - k1.time).max(1e-9));
            let (t2, t3) = (t * t, t * t * t);
            (2.0 * t3 - 3.0 * t2 + 1.0) * p1 + (t3 - 2.0 * t2 + t) * m1 + (3.0 * t2 - 2.0 * t3) * p2 + (t3 - t2) * m2
        };
        let unit = |key: &PathKey| {
            let [w, x, y, z] = key.rotation;
            Quat::from_xyzw(x, y, z, w).normalize()
        };
        let near = |a: Quat, b: Quat| if a.dot(b) < 0.0 { -b } else { b };
        let q1 = unit(&k1);
        let (q0, q2) = (near(q1, unit(&k0)), near(q1, unit(&k2)));
        let q3 = near(q2, unit(&k3));
        let inner = |before: Quat, q: Quat, after: Quat| {
            let (a, b) = (
                log(q.conjugate() * near(q, after)),
                log(q.conjugate() * near(q, before)),
            );
            q * exp(-(a + b) / 4.0)
        };
        let rotation = slerp(
            slerp(q1, q2, t),
            slerp(inner(q0, q1, q2), inner(q1, q2, q3), t),
            2.0 * t * (1.0 - t),
        );
        PathKey {
            time: seconds,
            position: [0, 1, 2].map(|c| spline(&|key: &PathKey| key.position[c])),
            rotation: [rotation.w, rotation.x, rotation.y, rotation.z],
            // Clamped: a field of view that overshoots its keys could turn the image upside down.
            fov: (spline(&|key: &PathKey| f64::from(key.fov)) as f32).clamp(k1.fov.min(k2.fov), k1.fov.max(k2.fov)),
        }
    }
}

/// Axis times half the angle of a unit quaternion.
fn log(q: Quat) -> Vec3 {
    let axis = Vec3::new(q.x, q.y, q.z);
    let sine = axis.length();
    if sine < 1e-9 {
        Vec3::ZERO
    } else {
        axis * (sine.atan2(q.w) / sine)
    }
}

/// The inverse of [`log`].
fn exp(v: Vec3) -> Quat {
    let angle = v.length();
    let axis = if angle < 1e-9 { v } else { v * (angle.sin() / angle) };
    Quat::from_xyzw(axis.x, axis.y, axis.z, angle.cos())
}

/// Spherical linear interpolation along the shorter arc.
fn slerp(a: Quat, b: Quat, t: f32) -> Quat {
    let cosine = a.dot(b);
    let (b, cosine) = if cosine < 0.0 { (-b, -cosine) } else { (b, cosine) };
    let (from, to) = if cosine < 0.9995 {
        let angle = cosine.acos();
        (((1.0 - t) * angle).sin() / angle.sin(), (t * angle).sin() / angle.sin())
    } else {
        (1.0 - t, t)
    };
    (a * from + b * to).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use irradia_scene::Similarity;
    use irradia_splat::{RenderOptions, Splats};
    use irradia_train::model::Model;

    fn path(loops: bool) -> CameraPath {
        let key = |i: usize| {
            let q = Quat::from_rotation_y(0.4 * i as f32) * Quat::from_rotation_x(0.1 * (i * i) as f32);
            PathKey {
                time: 1.5 * i as f32,
                position: [i as f64, (i * i) as f64 * 0.5, -(i as f64)],
                rotation: [q.w, q.x, q.y, q.z],
                fov: 0.8 + 0.1 * i as f32,
            }
        };
        CameraPath {
            irradia_path: 1,
            fps: 10.0,
            loops,
            ease: false,
            closing: 2.0,
            keys: (0..4).map(key).collect(),
        }
    }

    #[test]
    fn a_spiral_keeps_out_of_what_cameras_surround() {
        let ring = |part: f32| -> Vec<Camera> {
            let eye = |i: u32| {
                let angle = part * TAU * i as f32 / 24.0;
                Vec3::new(angle.cos(), angle.sin(), 0.2)
            };
            let look = |i| Pose::look_at(eye(i), Vec3::ZERO, Vec3::Z);
            let k = Intrinsics::from_fov_x(64, 48, 1.0);
            (0..24).map(|i| Camera::new(look(i), k)).collect()
        };
        for part in [1.0, 0.7, 0.5, 0.1] {
            let scene = Scene {
                model: Model::of_splats(Splats::zeros(1, 0)),
                options: RenderOptions::default(),
                cameras: Some(ring(part).into()),
                world_from_dataset: Similarity::IDENTITY,
                notes: Vec::new(),
            };
            let film = Film::spiral(&scene, 40, None);
            let nearest = film
                .cameras
                .iter()
                .map(|c| c.pose.position.length())
                .fold(f32::INFINITY, f32::min);
            assert!(nearest > 0.4, "{part}: {nearest}");
        }
    }

    #[test]
    fn a_path_through_the_training_cameras_counts_numbers_in_their_names() {
        let mut names = [
            "a/r_10.png",
            "b",
            "a/r_9.png",
            "a/r_009a.png",
            "a/r_2.png",
            "a/r_100.png",
            "1",
        ];
        names.sort_by_cached_key(|name| natural_key(name));
        let sorted = [
            "1",
            "a/r_2.png",
            "a/r_9.png",
            "a/r_009a.png",
            "a/r_10.png",
            "a/r_100.png",
            "b",
        ];
        assert_eq!(names, sorted);

        let camera = |x: f32| {
            let pose = Pose {
                rotation: Quat::IDENTITY,
                position: Vec3::new(x, 0.0, 0.0),
            };
            Camera::new(pose, Intrinsics::from_fov_x(64, 48, 1.0))
        };
        let scene = Scene {
            model: Model::of_splats(Splats::zeros(1, 0)),
            options: RenderOptions::default(),
            cameras: Some([0.0, 10.0, 2.0].map(camera).into()),
            world_from_dataset: Similarity::IDENTITY,
            notes: Vec::new(),
        };
        let names = ["r_0", "r_10", "r_2"].map(str::to_owned);
        for (names, expected) in [(&names[..], [0.0, 2.0, 10.0]), (&[], [0.0, 10.0, 2.0])] {
            let film = Film::training(&scene, names, 3, None).expect("there are cameras");
            for (camera, x) in film.cameras.iter().zip(expected) {
                assert!(
                    (camera.pose.position.x - x).abs() < 1e-4,
                    "{expected:?}: {}",
                    camera.pose.position
                );
            }
        }
    }

    #[test]
    fn keys_are_met_and_the_way_between_is_smooth() {
        for loops in [false, true] {
            let path = path(loops);
            for key in &path.keys {
                let at = path.at(key.time);
                assert!(
                    (0..3).all(|c| (at.position[c] - key.position[c]).abs() < 1e-4),
                    "{at:?}"
                );
                let dot: f32 = at.rotation.iter().zip(key.rotation).map(|(a, b)| a * b).sum();
                assert!(dot.abs() > 0.99999 && (at.fov - key.fov).abs() < 1e-4);
            }
            let step = 0.01f32;
            let height = |time: f32| path.at(time).position[1];
            let velocity = |time: f32| (height(time + step) - height(time)) / f64::from(step);
            for key in &path.keys[1..3] {
                // No kink: the velocity on both sides of a key is the same.
                assert!((velocity(key.time) - velocity(key.time - step)).abs() < 0.1);
            }
        }
        let looped = path(true);
        let (start, end) = (looped.at(0.0), looped.at(looped.seconds()));
        assert!((0..3).all(|c| (start.position[c] - end.position[c]).abs() < 1e-3));
    }

    #[test]
    fn a_field_of_view_stays_between_those_of_its_keys() {
        let mut zoom = path(false);
        for (key, fov) in zoom.keys.iter_mut().zip([1.9, 0.17, 0.17, 1.9]) {
            key.fov = fov;
        }
        let seconds = zoom.seconds();
        let between = |i: i32| zoom.at(seconds * i as f32 / 100.0).fov;
        assert!((0..=100).map(between).all(|fov| (0.17..=1.9).contains(&fov)));
    }

    #[test]
    fn files_of_the_viewer_and_of_nerfstudio_are_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("path.json");
        let write = |text: &str| fs::write(&file, text).expect("written");
        write(&serde_json::to_string(&path(false)).expect("plain data"));
        let film = Film::read(&file, &Transform::IDENTITY, None, (64, 48)).expect("a path");
        assert_eq!((film.cameras.len(), film.fps), (46, 10.0));
        write(
            r#"{"fps": 24, "render_width": 5, "camera_path": [
                {"camera_to_world": [1,0,0,3, 0,1,0,4, 0,0,1,5, 0,0,0,1], "fov": 90, "aspect": 1.5}]}"#,
        );
        let world = Similarity {
            scale: 0.5,
            center: DVec3::new(1.0, 0.0, -1.0),
        };
        let scaled = Film::read(&file, &Transform::to_world(&world), None, (64, 48)).expect("a path");
        assert_eq!(scaled.cameras[0].pose.position, Vec3::new(1.0, 2.0, 3.0));
        let film = Film::read(&file, &Transform::IDENTITY, None, (64, 48)).expect("a path");
        let camera = film.cameras[0];
        assert_eq!((film.fps, camera.pose.position), (24.0, Vec3::new(3.0, 4.0, 5.0)));
        // OpenGL looks along -z with y up.
        assert!((camera.pose.rotation * Vec3::Z + Vec3::Z).length() < 1e-5);
        assert!((camera.pose.rotation * Vec3::Y + Vec3::Y).length() < 1e-5);
        assert!((camera.intrinsics.fy - 24.0).abs() < 1e-3);
        // The size is the file's, unless one is asked for.
        let own_size = |more: &str, size| {
            write(&format!(
                r#"{{"render_width": 60, "render_height": 40, {more}
                "camera_path": [{{"camera_to_world": [1,0,0,3, 0,1,0,4, 0,0,1,5], "fov": 90}}]}}"#
            ));
            let film = Film::read(&file, &Transform::IDENTITY, size, (64, 48));
            film.map(|film| film.cameras[0].intrinsics.width)
        };
        assert_eq!(own_size("", None).expect("a path"), 60);
        assert_eq!(own_size("", Some((30, 20))).expect("a path"), 30);
        assert_eq!(own_size(r#""camera_type": "perspective","#, None).expect("a path"), 60);
        let error = own_size(r#""camera_type": "fisheye","#, None).expect_err("no pinholes");
        assert!(error.to_string().contains("type fisheye"), "{error}");
    }

    #[test]
    fn a_saved_path_moves_with_the_scene() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("path.json");
        let far = DVec3::new(5e6, -4e5, 100.0);
        let mut saved = path(false);
        for key in &mut saved.keys {
            key.position = (far + DVec3::from(key.position)).to_array();
        }
        fs::write(&file, serde_json::to_string(&saved).expect("plain data")).expect("written");
        let turn = DQuat::from_rotation_z(0.7);
        let moved = Transform::about(far, 2.0, turn);
        let world = Similarity {
            scale: 0.1,
            center: far,
        };
        let film = Film::read(&file, &moved.then(&Transform::to_world(&world)), None, (64, 48)).expect("a path");
        for (i, camera) in film.cameras.iter().enumerate() {
            let unmoved = path(false).camera(i as f32 / 10.0, 64, 48);
            let expected = 0.2 * (turn.as_quat() * unmoved.pose.position);
            assert!((camera.pose.position - expected).length() < 1e-5, "{i}");
            let rotation = turn.as_quat() * unmoved.pose.rotation;
            assert!(rotation.dot(camera.pose.rotation).abs() > 0.99999, "{i}");
            assert_eq!(camera.intrinsics, unmoved.intrinsics);
        }
    }

    #[test]
    fn hostile_files_are_refused_in_one_line() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("path.json");
        let good = serde_json::to_string(&path(false)).expect("plain data");
        for text in [
            "".to_owned(),
            "[]".to_owned(),
            "{\"camera_path\": []}".to_owned(),
            "{\"camera_path\": [{\"camera_to_world\": [1], \"fov\": 50}]}".to_owned(),
            good.replace("\"fps\":10.0", "\"fps\":0.0"),
            good.replace("\"fps\":10.0", "\"fps\":1e30"),
            good.replace("\"time\":4.5", "\"time\":1e30"),
            good.replace("\"time\":4.5", "\"time\":0.5"),
            good.replace("\"irradia_path\":1", "\"irradia_path\":2"),
            good.replacen("\"fov\":0.8", "\"fov\":4", 1),
            good.replacen("[0.0,0.0,-0.0]", "[1e300,0.0,0.0]", 1),
        ] {
            fs::write(&file, &text).expect("written");
            let error = Film::read(&file, &Transform::IDENTITY, None, (8, 8))
                .expect_err(&text)
                .to_string();
            assert!(!error.contains('\n') && error.contains("path.json"), "{error}");
            assert_eq!(error.contains("no frames"), text == "{\"camera_path\": []}", "{error}");
        }
    }
}
