//! Synthetic worlds of points with known cameras: keypoints and matches without images.
// Each test program uses a part of it.
#![allow(dead_code)]

use glam::{DQuat, DVec2, DVec3};
use irradia_scene::Rng;
use irradia_sfm::geometry::camera::DCamera;
use irradia_sfm::geometry::pose::DPose;
use irradia_sfm::map::{KnownGeometry, MapOptions, Model, PhotoInfo, Reconstruction, Sensor, extend, reconstruct};
use irradia_sfm::{Features, Keypoint, PairMatches};

/// Photographs, features and matches with known cameras.
#[derive(Clone, Default)]
pub struct World {
    pub photos: Vec<PhotoInfo>,
    pub features: Vec<Features>,
    pub pairs: Vec<PairMatches>,
    pub poses: Vec<DPose>,
}

pub const CAMERA: DCamera = DCamera {
    width: 1000,
    height: 750,
    parameters: [870.0, 870.0, 500.0, 375.0, 0.06, -0.04, 0.0, 0.0],
    fisheye: false,
};

/// A pose at `eye` that looks at `target`; +Z is up.
pub fn look(eye: DVec3, target: DVec3) -> DPose {
    let forward = (target - eye).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let rotation = DQuat::from_mat3(&glam::DMat3::from_cols(right, forward.cross(right), forward));
    DPose {
        rotation,
        position: eye,
    }
}

/// `photos` cameras on `turns` turns around the origin.
pub fn around(photos: usize, turns: f64) -> Vec<DPose> {
    (0..photos)
        .map(|i| {
            let angle = std::f64::consts::TAU * turns * i as f64 / photos as f64;
            let eye = DVec3::new(5.0 * angle.cos(), 5.0 * angle.sin(), 1.5 + (3.0 * angle).sin());
            look(
                eye,
                DVec3::new(0.1 * (7.0 * angle).sin(), 0.1 * (5.0 * angle).cos(), 0.0),
            )
        })
        .collect()
}

impl World {
    /// Points in a cube of side 5, each seen by those of `poses` that it faces, with noise of `noise` px and a fraction `wrong` of
    /// wrong matches.
    pub fn new(poses: Vec<DPose>, points: usize, noise: f64, wrong: f64, seed: u64) -> Self {
        let mut rng = Rng::new(seed, 1);
        let mut uniform = move || f64::from(rng.range(-1.0, 1.0));
        let mut direction = move || DVec3::new(uniform(), uniform(), uniform());
        // Position and the direction in which a point faces.
        let points: Vec<(DVec3, DVec3)> = (0..points)
            .map(|_| (2.5 * direction(), direction().normalize()))
            .collect();
        Self::of_points(CAMERA, poses, &points, 0, noise, wrong, seed)
    }

    /// A world of points, each with the direction in which it faces. The first `twins` points look like the next `twins` ones.
    pub fn of_points(
        camera: DCamera,
        poses: Vec<DPose>,
        points: &[(DVec3, DVec3)],
        twins: usize,
        noise: f64,
        wrong: f64,
        seed: u64,
    ) -> Self {
        let look = |point: usize| if point < 2 * twins { point % twins } else { point };
        let mut world = Self {
            poses,
            ..Self::default()
        };
        // The point of each keypoint.
        let mut shown: Vec<Vec<usize>> = Vec::new();
        let mut rng = Rng::new(seed, 2);
        for (i, pose) in world.poses.iter().enumerate() {
            let mut keypoints = Vec::new();
            let mut here = Vec::new();
            let mut order: Vec<usize> = (0..points.len()).collect();
            rng.shuffle(&mut order);
            for point in order {
                let (place, normal) = points[point];
                let p = pose.camera_from_world(place);
                let facing = (pose.position - place).normalize().dot(normal);
                if p.z < 0.1 || facing < 0.35 || rng.uniform() < 0.2 {
                    continue;
                }
                let at = camera.pixel(p) + noise * DVec2::new(f64::from(rng.normal()), f64::from(rng.normal()));
                if at.x < 0.0 || at.y < 0.0 || at.x > camera.width.into() || at.y > camera.height.into() {
                    continue;
                }
                keypoints.push(Keypoint {
                    x: at.x as f32,
                    y: at.y as f32,
                    scale: 2.0,
                    angle: 0.0,
                });
                here.push(point);
            }
            shown.push(here);
            world.features.push(Features {
                keypoints,
                ..Features::default()
            });
            world
                .photos
                .push(PhotoInfo::new(format!("{i:03}.jpg"), camera.width, camera.height));
        }
        for a in 0..shown.len() {
            for b in a + 1..shown.len() {
                let mut matches: Vec<[u32; 2]> = Vec::new();
                let mut free_b = vec![true; shown[b].len()];
                let mut place_b = vec![None; points.len()];
                shown[b]
                    .iter()
                    .enumerate()
                    .for_each(|(j, point)| place_b[look(*point)] = Some(j));
                for (i, point) in shown[a].iter().enumerate() {
                    let right = place_b[look(*point)];
                    let chance = rng.below(shown[b].len().max(1) as u32) as usize;
                    let j = if f64::from(rng.uniform()) < wrong {
                        Some(chance)
                    } else {
                        right
                    };
                    if let Some(j) = j
                        && j < free_b.len()
                        && free_b[j]
                    {
                        free_b[j] = false;
                        matches.push([i as u32, j as u32]);
                    }
                }
                if matches.len() >= 8 {
                    world.pairs.push(PairMatches {
                        photos: [a as u32, b as u32],
                        matches,
                    });
                }
            }
        }
        world
    }

    /// The world with the photographs from `first` on enlarged about their centre by `ratio`: keypoints that leave them have no matches.
    pub fn zoomed(mut self, first: usize, ratio: f32) -> Self {
        let center = [0.5 * CAMERA.width as f32, 0.5 * CAMERA.height as f32];
        for features in &mut self.features[first..] {
            for k in &mut features.keypoints {
                k.x = center[0] + ratio * (k.x - center[0]);
                k.y = center[1] + ratio * (k.y - center[1]);
            }
        }
        self.without_outside_matches()
    }

    /// The world with each photograph turned clockwise by `turns` quarter turns, as if its camera had been held so: those with 0, 1, 2, and
    /// 3 are in groups of these numbers.
    pub fn turned(mut self, turns: impl Fn(usize) -> u8) -> Self {
        let photos = self.photos.iter_mut().zip(&mut self.features).zip(&mut self.poses);
        for (i, ((photo, features), pose)) in photos.enumerate() {
            let quarter_turns = turns(i);
            photo.group = quarter_turns.into();
            photo.sensor = Some(Sensor {
                camera: 0,
                quarter_turns,
            });
            *pose = pose.turned(quarter_turns);
            for _ in 0..quarter_turns {
                for k in &mut features.keypoints {
                    (k.x, k.y) = (photo.height as f32 - k.y, k.x);
                }
                (photo.width, photo.height) = (photo.height, photo.width);
            }
        }
        self
    }

    /// The world with each photograph cropped around its centre to `keep` times its size: each has its own camera.
    pub fn cropped(self, keep: impl Fn(usize) -> f64) -> Self {
        self.cropped_beside(keep, |_| [0.5; 2])
    }

    /// Like [`Self::cropped`], with the fractions `before` of the cropped width and height removed at the left and at the top.
    pub fn cropped_beside(mut self, keep: impl Fn(usize) -> f64, before: impl Fn(usize) -> [f64; 2]) -> Self {
        for (i, (photo, features)) in self.photos.iter_mut().zip(&mut self.features).enumerate() {
            let side = |side: u32| (f64::from(side) * keep(i) / 2.0).round() as u32 * 2;
            (photo.width, photo.height, photo.group) = (side(CAMERA.width), side(CAMERA.height), i);
            let [left, above] = before(i).map(|fraction| fraction as f32);
            for k in &mut features.keypoints {
                k.x -= left * (CAMERA.width - photo.width) as f32;
                k.y -= above * (CAMERA.height - photo.height) as f32;
            }
        }
        self.without_outside_matches()
    }

    /// The world without the matches of keypoints outside their photographs.
    fn without_outside_matches(mut self) -> Self {
        for pair in &mut self.pairs {
            let seen = |side: usize, keypoint: u32| {
                let photo = pair.photos[side] as usize;
                let k = &self.features[photo].keypoints[keypoint as usize];
                let PhotoInfo { width, height, .. } = self.photos[photo];
                (0.0..width as f32).contains(&k.x) && (0.0..height as f32).contains(&k.y)
            };
            pair.matches.retain(|m| seen(0, m[0]) && seen(1, m[1]));
        }
        self
    }

    /// Both worlds, without matches between them; the second has another camera.
    pub fn and(mut self, other: Self) -> Self {
        let shift = self.photos.len() as u32;
        self.photos
            .extend(other.photos.into_iter().map(|p| PhotoInfo { group: 1, ..p }));
        self.features.extend(other.features);
        self.poses.extend(other.poses);
        self.pairs.extend(other.pairs.into_iter().map(|p| PairMatches {
            photos: p.photos.map(|p| p + shift),
            matches: p.matches,
        }));
        self
    }

    /// Like [`Self::map`], beginning with what is known.
    pub fn extend(&self, known: &KnownGeometry) -> Reconstruction {
        let options = MapOptions::default();
        extend(&self.photos, &self.features, &self.pairs, known, &options, &mut |_| ())
    }

    pub fn map(&self) -> Reconstruction {
        reconstruct(
            &self.photos,
            &self.features,
            &self.pairs,
            &MapOptions::default(),
            &mut |_| (),
        )
    }

    /// The area under the recall curve of relative poses up to `degrees`, in percent: errors of rotation and of the direction
    /// of translation, the larger of both; a pair with an unregistered photograph is wrong.
    pub fn auc(&self, model: &Model, degrees: f64) -> f64 {
        let mut errors = Vec::new();
        for a in 0..self.poses.len() {
            for b in a + 1..self.poses.len() {
                let (Some(found_a), Some(found_b)) = (model.poses[a], model.poses[b]) else {
                    errors.push(f64::INFINITY);
                    continue;
                };
                let relative =
                    |a: &DPose, b: &DPose| (b.rotation.inverse() * a.rotation, b.camera_from_world(a.position));
                let (truth, found) = (relative(&self.poses[a], &self.poses[b]), relative(&found_a, &found_b));
                let turn = 2.0 * (truth.0.inverse() * found.0).w.abs().min(1.0).acos();
                errors.push(turn.max(truth.1.angle_between(found.1)).to_degrees());
            }
        }
        100.0 * errors.iter().map(|e| (1.0 - e / degrees).max(0.0)).sum::<f64>() / errors.len() as f64
    }
}
