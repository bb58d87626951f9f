//! `transforms*.json`: cameras and frames of NeRF's Blender scenes, instant-ngp and nerfstudio.

use super::declared::{DeclaredCamera, DeclaredPose, Focal, lens_or_pinhole, pose_from_axes};
use super::readout::shutter_from_velocities;
use crate::Malformed;
use crate::json::parse_json;
use glam::DVec3;
use irradia_scene::{Lens, RollingShutter};
use serde::Deserialize;

/// A `transforms.json`.
#[derive(Clone, Debug, Deserialize)]
pub struct Transforms {
    /// Intrinsics of all frames without their own.
    #[serde(flatten)]
    pub camera: CameraKeys,
    /// The photographs.
    pub frames: Vec<Frame>,
    /// Readout time of a rolling shutter, from the first row to the last, seconds.
    pub rolling_shutter_time: Option<f64>,
    /// A point cloud in the same world, relative to the file.
    pub ply_file_path: Option<String>,
    /// `file_path` of the training frames.
    pub train_filenames: Option<Vec<String>>,
    /// `file_path` of the frames for validation.
    pub val_filenames: Option<Vec<String>>,
    /// `file_path` of the held-out frames.
    pub test_filenames: Option<Vec<String>>,
}

/// One photograph.
#[derive(Clone, Debug, Deserialize)]
pub struct Frame {
    /// The image, relative to the file, with or without extension.
    pub file_path: String,
    /// Camera-to-world with OpenGL axes, 3x4 or 4x4, row-major; numbers that are not finite are `None`.
    pub transform_matrix: Vec<Vec<Option<f64>>>,
    /// The mask, relative to the file; white is kept.
    pub mask_path: Option<String>,
    /// The depth map, relative to the file.
    pub depth_file_path: Option<String>,
    /// The same, as named in files for instant-ngp.
    pub depth_path: Option<String>,
    /// The normal map, relative to the file.
    pub normal_file_path: Option<String>,
    /// The same under another name.
    pub normal_path: Option<String>,
    /// Time of capture (D-NeRF: 0 to 1 over the capture).
    pub time: Option<f64>,
    /// Velocity of the camera along its own OpenGL axes, per second (this key and the next: "Gaussian Splatting on the Move").
    pub camera_linear_velocity: Option<[Option<f64>; 3]>,
    /// Angular velocity about its own OpenGL axes, radians per second.
    pub camera_angular_velocity: Option<[Option<f64>; 3]>,
    /// Intrinsics of this frame only.
    #[serde(flatten)]
    pub camera: CameraKeys,
}

impl Frame {
    /// The depth map, under either name.
    pub fn depth(&self) -> &Option<String> {
        either(&self.depth_file_path, &self.depth_path)
    }

    /// The normal map, under either name.
    pub fn normals(&self) -> &Option<String> {
        either(&self.normal_file_path, &self.normal_path)
    }
}

fn either<'a>(first: &'a Option<String>, second: &'a Option<String>) -> &'a Option<String> {
    if first.is_some() { first } else { second }
}

/// The keys of a camera's intrinsics; global or in a frame.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[allow(missing_docs)] // The format's own names.
pub struct CameraKeys {
    pub camera_model: Option<String>,
    pub is_fisheye: Option<bool>,
    pub w: Option<f64>,
    pub h: Option<f64>,
    pub fl_x: Option<f64>,
    pub fl_y: Option<f64>,
    pub camera_angle_x: Option<f64>,
    pub camera_angle_y: Option<f64>,
    /// instant-ngp's angles, degrees.
    pub x_fov: Option<f64>,
    pub y_fov: Option<f64>,
    /// Lenses of instant-ngp that are not supported.
    pub equirectangular: Option<bool>,
    pub latlong: Option<bool>,
    pub ftheta_p0: Option<f64>,
    pub cx: Option<f64>,
    pub cy: Option<f64>,
    pub k1: Option<f64>,
    pub k2: Option<f64>,
    pub k3: Option<f64>,
    pub k4: Option<f64>,
    pub p1: Option<f64>,
    pub p2: Option<f64>,
}

/// Parses a `transforms.json`.
///
/// # Errors
/// When it is not JSON, or lacks `frames`, a `file_path` or a `transform_matrix`; with line and column.
pub fn parse_transforms(bytes: &[u8]) -> Result<Transforms, Malformed> {
    parse_json(bytes, "transforms file")
}

impl CameraKeys {
    /// These keys, and `others` for missing ones.
    ///
    /// A frame's focal lengths and global ones of another kind are not mixed.
    pub(super) fn or(&self, others: &Self) -> Self {
        let [x, y] = self.angles();
        let own_focal = self.fl_x.or(self.fl_y).or(x).or(y).is_some();
        let focal = if own_focal { self } else { others };
        Self {
            camera_model: self.camera_model.clone().or_else(|| others.camera_model.clone()),
            is_fisheye: self.is_fisheye.or(others.is_fisheye),
            w: self.w.or(others.w),
            h: self.h.or(others.h),
            fl_x: focal.fl_x,
            fl_y: focal.fl_y,
            camera_angle_x: focal.camera_angle_x,
            camera_angle_y: focal.camera_angle_y,
            x_fov: focal.x_fov,
            y_fov: focal.y_fov,
            equirectangular: self.equirectangular.or(others.equirectangular),
            latlong: self.latlong.or(others.latlong),
            ftheta_p0: self.ftheta_p0.or(others.ftheta_p0),
            cx: self.cx.or(others.cx),
            cy: self.cy.or(others.cy),
            k1: self.k1.or(others.k1),
            k2: self.k2.or(others.k2),
            k3: self.k3.or(others.k3),
            k4: self.k4.or(others.k4),
            p1: self.p1.or(others.p1),
            p2: self.p2.or(others.p2),
        }
    }

    /// The fields of view, radians.
    fn angles(&self) -> [Option<f64>; 2] {
        [
            self.camera_angle_x.or(self.x_fov.map(f64::to_radians)),
            self.camera_angle_y.or(self.y_fov.map(f64::to_radians)),
        ]
    }

    /// The name of its lens if it is one of instant-ngp's that are not supported. They have a focal length as well, without a meaning.
    fn unsupported_lens(&self) -> Option<&'static str> {
        let flags = [("equirectangular", self.equirectangular), ("latlong", self.latlong)];
        let flagged = flags.into_iter().find(|(_, is_set)| *is_set == Some(true));
        flagged.map(|(name, _)| name).or(self.ftheta_p0.map(|_| "ftheta"))
    }

    /// The camera. Focal lengths in pixels take precedence over angles; a missing principal point is at the image's centre.
    ///
    /// Coefficients: `k1 k2 p1 p2` are OpenCV's, `k3` is its third radial one. A `k4` belongs to the fisheye model; for other
    /// models, it is a fourth radial coefficient in nerfstudio's files, which nerfstudio's undistortion rejects unless it is zero,
    /// as does this function.
    pub(super) fn camera(&self) -> Result<DeclaredCamera, Malformed> {
        if self.camera_model.as_deref() == Some("EQUIRECTANGULAR") {
            return Ok(DeclaredCamera::panorama());
        }
        if let Some(lens) = self.unsupported_lens() {
            return Err(Malformed(format!(
                "the lens {lens} of instant-ngp is not supported; undistort the photographs, or set camera_model to EQUIRECTANGULAR if \
                 they are panoramas"
            )));
        }
        let focal = match (self.fl_x, self.fl_y) {
            (Some(x), y) => Focal::Pixels([x, y.unwrap_or(x)]),
            (None, Some(y)) => Focal::Pixels([y, y]),
            (None, None) if self.angles() != [None; 2] => Focal::Angles(self.angles()),
            (None, None) => {
                return Err(Malformed(
                    "has no intrinsics; set fl_x (and fl_y, cx, cy, w, h) in pixels or camera_angle_x in radians, for \
                     all frames or in each"
                        .into(),
                ));
            }
        };
        let k = [self.k1, self.k2, self.k3, self.k4].map(|k| k.unwrap_or(0.0));
        let p = [self.p1, self.p2].map(|p| p.unwrap_or(0.0));
        let model = match (self.is_fisheye, self.camera_model.as_deref()) {
            (Some(true), _) => "OPENCV_FISHEYE",
            (_, model) => model.unwrap_or("OPENCV"),
        };
        let lens = match model {
            "OPENCV_FISHEYE" => Lens::fisheye(k),
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "PERSPECTIVE" => {
                if k[3] != 0.0 {
                    return Err(Malformed(format!(
                        "k4 is {} and the camera model {model} has no fourth radial coefficient; set k4 to 0, or camera_model \
                         to OPENCV_FISHEYE if it is one",
                        k[3]
                    )));
                }
                Lens::brown([k[0], k[1], k[2]], p)
            }
            other => {
                return Err(Malformed(format!(
                    "the camera model {other} is not supported; use PINHOLE, OPENCV, OPENCV_FISHEYE or EQUIRECTANGULAR"
                )));
            }
        };
        let size = match (self.w, self.h) {
            (Some(w), Some(h)) if w >= 1.0 && h >= 1.0 => Some([w, h]),
            _ => None,
        };
        // An incomplete principal point is treated as missing.
        let center = self.cx.zip(self.cy).map(|(x, y)| [x, y]);
        Ok(DeclaredCamera {
            size,
            focal,
            center,
            lens: lens_or_pinhole(lens),
        })
    }
}

impl Frame {
    /// The pose in OpenCV axes: the file's cameras look along -Z with Y up.
    pub(super) fn pose(&self) -> Option<DeclaredPose> {
        let number = |row: usize, column: usize| *self.transform_matrix.get(row)?.get(column)?;
        let column = |c: usize| Some(DVec3::new(number(0, c)?, number(1, c)?, number(2, c)?));
        pose_from_axes(column(0)?, -column(1)?, -column(2)?, column(3)?)
    }

    /// How the camera moved while the photograph was read out.
    pub(super) fn shutter(&self, seconds: Option<f64>) -> Option<RollingShutter> {
        shutter_from_velocities(self.camera_linear_velocity?, self.camera_angular_velocity?, seconds?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn a_frame_overrides_globals_and_axes_are_flipped() {
        let text = r#"{"w": 100.0, "h": 50, "fl_x": 80, "k1": 0.1, "frames": [
            {"file_path": "a NaN.png", "transform_matrix": [[1,0,0,1],[0,1,0,2],[0,0,1,3]]},
            {"file_path": "b.png", "camera_angle_x": 1.5707963267948966, "k1": 0,
             "transform_matrix": [[1,0,0,NaN],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}]}"#;
        let transforms = parse_transforms(text.as_bytes()).unwrap();
        let [a, b] = &transforms.frames[..] else {
            panic!("two frames")
        };
        let pose = a.pose().unwrap();
        assert_eq!(pose.position, DVec3::new(1.0, 2.0, 3.0));
        assert!(
            (pose.rotation * DVec3::Z - DVec3::NEG_Z).length() < 1e-6,
            "looks along -Z"
        );
        assert!((pose.rotation * DVec3::Y - DVec3::NEG_Y).length() < 1e-6, "down is -Y");
        assert_eq!((a.file_path.as_str(), b.pose()), ("a NaN.png", None));
        let camera = a.camera.or(&transforms.camera).camera().unwrap();
        assert_eq!(camera.at_size(50, 25).fx, 40.0);
        assert_eq!(camera.at_size(50, 25).cy, 12.5);
        let camera = b.camera.or(&transforms.camera).camera().unwrap();
        assert_eq!(camera.lens, Lens::Pinhole);
        assert!((camera.at_size(100, 50).fx - 50.0).abs() < 1e-4);
    }

    #[test]
    fn missing_and_unsupported_intrinsics_are_named() {
        let error = CameraKeys::default().camera().unwrap_err().to_string();
        assert!(error.contains("fl_x") && error.contains("camera_angle_x"), "{error}");
        let keys = CameraKeys {
            fl_x: Some(1.0),
            camera_model: Some("ORTHOPHOTO".into()),
            ..Default::default()
        };
        assert!(keys.camera().unwrap_err().to_string().contains("ORTHOPHOTO"));
        let panorama = CameraKeys {
            camera_model: Some("EQUIRECTANGULAR".into()),
            ..Default::default()
        };
        let k = panorama.camera().unwrap().at_size(200, 100);
        assert_eq!((k.lens, k.cx, k.cy), (Lens::Equirectangular, 100.0, 50.0));
        assert!((k.fx - k.fy).abs() < 1e-5 && (k.fx - 100.0 / std::f32::consts::PI).abs() < 1e-4);
        let keys = CameraKeys {
            fl_x: Some(1.0),
            k4: Some(0.1),
            ..Default::default()
        };
        assert!(keys.camera().unwrap_err().to_string().contains("k4"));
        let camera = |keys: &str| {
            let text = format!(r#"{{{keys}, "frames": []}}"#);
            parse_transforms(text.as_bytes()).unwrap().camera.camera()
        };
        let wide = camera(r#""x_fov": 90.0, "w": 100, "h": 50"#).unwrap();
        assert!((wide.at_size(100, 50).fx - 50.0).abs() < 1e-4, "degrees");
        for lens in [
            r#""latlong": true"#,
            r#""equirectangular": true"#,
            r#""ftheta_p0": 0.1"#,
        ] {
            let error = camera(&format!(r#""fl_x": 50, {lens}"#)).unwrap_err().to_string();
            assert!(error.contains("is not supported"), "{error}");
        }
        assert!(camera(r#""fl_x": 50, "latlong": false"#).is_ok());
        let fisheye = CameraKeys {
            is_fisheye: Some(true),
            ..keys
        };
        assert_eq!(fisheye.camera().unwrap().lens, Lens::fisheye([0.0, 0.0, 0.0, 0.1]));
        let error = parse_transforms(br#"{"frames": [{"transform_matrix": []}]}"#)
            .unwrap_err()
            .to_string();
        assert!(error.contains("file_path"), "{error}");
    }

    #[test]
    fn velocities_become_a_movement_in_opencv_axes() {
        let text = br#"{"rolling_shutter_time": 0.02, "fl_x": 50, "w": 100, "h": 100, "frames": [
            {"file_path": "a", "transform_matrix": [], "camera_linear_velocity": [1, 2, 3], "camera_angular_velocity": [0, 0.5, 0]},
            {"file_path": "b", "transform_matrix": [], "camera_linear_velocity": [0, 0, 0], "camera_angular_velocity": [0, 0, 0]},
            {"file_path": "c", "transform_matrix": [], "camera_linear_velocity": [1, NaN, 0], "camera_angular_velocity": [0, 0, 0]},
            {"file_path": "d", "transform_matrix": [], "camera_linear_velocity": [1, 0, 0], "camera_angular_velocity": [0, 1e9, 0]},
            {"file_path": "e", "transform_matrix": []}]}"#;
        let transforms = parse_transforms(text).unwrap();
        let shutters: Vec<_> = transforms
            .frames
            .iter()
            .map(|frame| frame.shutter(transforms.rolling_shutter_time))
            .collect();
        let moving = shutters[0].expect("it moves");
        assert!(moving.translation.distance(Vec3::new(0.02, -0.04, -0.06)) < 1e-7);
        assert!(moving.rotation.distance(Vec3::new(0.0, -0.01, 0.0)) < 1e-7);
        assert!(shutters[1..].iter().all(Option::is_none), "{shutters:?}");
    }

    #[test]
    fn sheared_mirrored_and_flat_matrices_are_rejected() {
        let frame = |rows: [[f64; 4]; 3]| Frame {
            file_path: String::new(),
            transform_matrix: rows.map(|row| row.map(Some).to_vec()).to_vec(),
            mask_path: None,
            depth_file_path: None,
            depth_path: None,
            normal_file_path: None,
            normal_path: None,
            time: None,
            camera_linear_velocity: None,
            camera_angular_velocity: None,
            camera: CameraKeys::default(),
        };
        let good = [[2.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]];
        assert!(frame(good).pose().is_some(), "a scale is removed");
        let mut bad = good;
        bad[0][0] = -2.0;
        assert_eq!(frame(bad).pose(), None);
        bad[0][0] = 0.0;
        assert_eq!(frame(bad).pose(), None);
        bad = good;
        bad[0][1] = 1.0;
        assert_eq!(frame(bad).pose(), None);
        bad[0][1] = f64::NAN;
        assert_eq!(frame(bad).pose(), None);
    }
}
