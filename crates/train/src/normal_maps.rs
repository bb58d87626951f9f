//! Normal maps given with photographs, from a network or a renderer, as the reference of a loss.
//!
//! Files contain them in the camera's axes, by the convention of OpenCV or of OpenGL, or in the world's axes, and do not say which. A
//! surface that a photograph shows faces the camera: all maps of a dataset are taken to be in the axes in which most of the normals do.

use crate::photos::caught;
use crate::recipe::Param;
use crate::schedule::StepPlan;
use crate::trainer::Trainer;
use glam::{Vec2, Vec3};
use irradia_measure::NormalSample;
use irradia_scene::{Camera, Dataset, NormalGrid};
use rayon::prelude::*;

/// Minimum length of a known normal.
const MIN_LENGTH: f32 = 0.5;
/// Minimum fraction of the normals that face the cameras.
const MIN_FACING_FRACTION: f64 = 0.9;
/// Difference up to which two such fractions count as equal.
const FRACTION_TOLERANCE: f64 = 0.01;

/// The maps of a dataset's training views, in their cameras' axes (x right, y down, z forward).
#[derive(Default)]
pub(crate) struct NormalMaps {
    /// By view.
    by_view: Vec<Option<NormalGrid>>,
    /// What was found, one line.
    pub summary: String,
}

/// The axes of a map's normals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Axes {
    /// x right, y down, z forward.
    OpenCv,
    /// x right, y up, z backward.
    OpenGl,
    World,
}

impl Axes {
    const ALL: [Self; 3] = [Self::OpenCv, Self::OpenGl, Self::World];

    /// `normal` in the axes of `camera`, of unit length; `None` if it is unknown.
    fn in_camera(self, normal: [f32; 3], camera: &Camera) -> Option<Vec3> {
        let normal = Vec3::from_array(normal);
        let turned = match self {
            Self::OpenCv => normal,
            Self::OpenGl => Vec3::new(normal.x, -normal.y, -normal.z),
            Self::World => camera.pose.rotation.inverse() * normal,
        };
        (normal.length() >= MIN_LENGTH).then(|| turned.normalize())
    }

    fn name(self) -> &'static str {
        match self {
            Self::OpenCv => "in the axes of their cameras, y down",
            Self::OpenGl => "in the axes of their cameras, y up",
            Self::World => "in the axes of the world",
        }
    }
}

impl NormalMaps {
    /// Whether any training view has a map.
    pub fn are_given(dataset: &Dataset) -> bool {
        dataset
            .train
            .iter()
            .any(|view| dataset.views[*view].normal_map.is_some())
    }

    /// Reads the maps of the training views.
    pub fn read(dataset: &Dataset) -> Self {
        let read = |index: &usize| {
            let view = &dataset.views[*index];
            let source = view.normal_map.as_ref()?;
            Some((*index, caught(&view.name, || source.load())))
        };
        let maps: Vec<_> = dataset.train.par_iter().filter_map(read).collect();
        let given = maps.len();
        let unreadable = maps
            .iter()
            .find_map(|(_, map)| map.as_ref().err())
            .map(|error| format!("; {error}"));
        let mut maps: Vec<(usize, NormalGrid)> = maps.into_iter().filter_map(|(i, map)| Some((i, map.ok()?))).collect();
        let shares = Axes::ALL.map(|axes| (axes, facing_fraction(dataset, &maps, axes)));
        // The first of equal ones: normals in a camera's axes may well face it if they are taken for the world's, but hardly the reverse.
        let (axes, share) = shares
            .into_iter()
            .reduce(|best, next| {
                if next.1 > best.1 + FRACTION_TOLERANCE {
                    next
                } else {
                    best
                }
            })
            .expect("there are axes");
        let mut by_view: Vec<Option<NormalGrid>> = dataset.views.iter().map(|_| None).collect();
        if share >= MIN_FACING_FRACTION {
            for (view, map) in &mut maps {
                let camera = &dataset.views[*view].camera;
                for normal in &mut map.values {
                    *normal = axes.in_camera(*normal, camera).unwrap_or_default().to_array();
                }
            }
            for (view, map) in maps {
                by_view[view] = Some(map);
            }
        }
        let used = by_view.iter().flatten().count();
        let found = if share >= MIN_FACING_FRACTION {
            axes.name().to_owned()
        } else {
            format!(
                "at most {:.0} % of their normals face the cameras in any known axes",
                100.0 * share
            )
        };
        Self {
            by_view,
            summary: format!(
                "{used} of {given} given maps of normals are used ({found}){}",
                unreadable.unwrap_or_default()
            ),
        }
    }

    /// Whether no map can be used.
    pub fn is_empty(&self) -> bool {
        self.by_view.iter().all(Option::is_none)
    }

    /// The normals of `view` at the pixels of `camera`, and half of their spacing, pixels.
    pub fn samples(&self, view: usize, camera: &Camera) -> Option<(Vec<NormalSample>, u32)> {
        let grid = self.by_view.get(view)?.as_ref()?;
        let k = &camera.intrinsics;
        let known = grid
            .pixels(k.width, k.height)
            .filter(|(_, normal)| **normal != [0.0; 3]);
        let samples = known.map(|(pixel, normal)| NormalSample { pixel, normal: *normal });
        Some((samples.collect(), (k.width / (2 * grid.columns)).max(1)))
    }
}

/// The fraction of the normals of `maps` that face their cameras if they are in `axes`.
fn facing_fraction(dataset: &Dataset, maps: &[(usize, NormalGrid)], axes: Axes) -> f64 {
    let (mut facing, mut known) = (0usize, 0usize);
    for (view, map) in maps {
        let camera = &dataset.views[*view].camera;
        let k = &camera.intrinsics;
        for ([x, y], normal) in map.pixels(k.width, k.height) {
            let Some(normal) = axes.in_camera(*normal, camera) else {
                continue;
            };
            let ray = k.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
            known += 1;
            facing += usize::from(normal.dot(ray) < 0.0);
        }
    }
    facing as f64 / known.max(1) as f64
}

impl Trainer {
    /// Normals of the map given with the photograph of view `view`, if the plan uses them.
    pub(crate) fn given_normals(
        &mut self,
        view: usize,
        camera: &Camera,
        plan: &StepPlan,
    ) -> Option<(Vec<NormalSample>, u32)> {
        if plan.value(Param::NormalMapWeight) <= 0.0 {
            return None;
        }
        // A resumed run reads them again.
        let maps = self.normal_maps.get_or_insert_with(|| NormalMaps::read(&self.dataset));
        maps.samples(view, camera)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{Quat, Vec2};
    use irradia_scene::{GridSource, Intrinsics, LoadError, Photo, Pose, Rng, View};
    use std::sync::Arc;

    /// Number of cells along each side.
    const CELLS: u32 = 8;

    struct Broken;

    impl GridSource<[f32; 3]> for Broken {
        fn load(&self) -> Result<NormalGrid, LoadError> {
            Err(LoadError("normals/b.png: ends too early".into()))
        }
    }

    /// Two cameras side by side that look down at a floor. `of` computes the normals of a map from the floor's normal, world, and the
    /// camera.
    fn dataset(of: impl Fn(Vec3, &Camera) -> [f32; 3]) -> Dataset {
        let view = |i: i32| {
            let rotation = Quat::from_rotation_y(0.8 * i as f32) * Quat::from_rotation_x(-0.7);
            let pose = Pose {
                rotation,
                position: Vec3::new(i as f32, -2.0, 0.0),
            };
            let camera = Camera::new(pose, Intrinsics::from_fov_x(64, 64, 0.8));
            let map = NormalGrid {
                columns: CELLS,
                rows: CELLS,
                values: vec![of(Vec3::NEG_Y, &camera); (CELLS * CELLS) as usize],
            };
            View {
                normal_map: Some(Arc::new(map)),
                ..View::new(
                    format!("{i}.png"),
                    camera,
                    Arc::new(Photo {
                        width: 64,
                        height: 64,
                        channels: 3,
                        data: vec![0; 3 * 64 * 64],
                        mask: None,
                    }),
                )
            }
        };
        let views = vec![view(0), view(2)];
        Dataset {
            train: vec![0, 1],
            views,
            ..Dataset::default()
        }
    }

    #[test]
    fn axes_are_those_in_which_surfaces_face_the_cameras() {
        let in_camera = |normal: Vec3, camera: &Camera| camera.pose.rotation.inverse() * normal;
        let opencv = dataset(|normal, camera| in_camera(normal, camera).to_array());
        let opengl = dataset(|normal, camera| {
            let n = in_camera(normal, camera);
            [n.x, -n.y, -n.z]
        });
        let world = dataset(|normal, _| normal.to_array());
        for (data, axes) in [(opencv, "y down"), (opengl, "y up"), (world, "of the world")] {
            let maps = NormalMaps::read(&data);
            assert!(
                maps.summary.starts_with("2 of 2") && maps.summary.contains(axes),
                "{}",
                maps.summary
            );
            for (i, view) in data.views.iter().enumerate() {
                let (samples, reach) = maps.samples(i, &view.camera).unwrap();
                assert_eq!((samples.len(), reach), ((CELLS * CELLS) as usize, 4));
                let wanted = in_camera(Vec3::NEG_Y, &view.camera);
                assert!(
                    samples
                        .iter()
                        .all(|sample| Vec3::from_array(sample.normal).distance(wanted) < 1e-5)
                );
                // At the centres of the cells.
                let [x, y] = samples[CELLS as usize + 2].pixel;
                assert_eq!(Vec2::new(x as f32, y as f32), Vec2::new(20.0, 12.0));
            }
        }
    }

    #[test]
    fn normals_in_no_known_axes_and_broken_maps_do_not_count() {
        let mut rng = Rng::new(2, 2);
        let mut noise = dataset(|normal, _| normal.to_array());
        for view in &mut noise.views {
            let values = (0..CELLS * CELLS)
                .map(|_| [0; 3].map(|_| rng.range(-1.0, 1.0)))
                .collect();
            view.normal_map = Some(Arc::new(NormalGrid {
                columns: CELLS,
                rows: CELLS,
                values,
            }));
        }
        let maps = NormalMaps::read(&noise);
        assert!(
            maps.is_empty() && maps.summary.starts_with("0 of 2"),
            "{}",
            maps.summary
        );
        let mut broken = dataset(|normal, _| normal.to_array());
        broken.views[1].normal_map = Some(Arc::new(Broken));
        let maps = NormalMaps::read(&broken);
        assert!(
            maps.summary.starts_with("1 of 2") && maps.summary.ends_with("normals/b.png: ends too early"),
            "{}",
            maps.summary
        );
        assert!(
            maps.samples(0, &broken.views[0].camera).is_some() && maps.samples(1, &broken.views[1].camera).is_none()
        );
    }
}
