//! Messages from and to a page. Text messages are JSON; pictures are binary: the length of a JSON header (u32,
//! little endian), the header, a JPEG.

use glam::{Quat, Vec3};
use irradia_edit::{Edit, EditError, EditList, Operation, SelectStep, Shape};
use irradia_scene::{Camera, Intrinsics, Pose};
use serde::{Deserialize, Serialize};

/// Largest message accepted from a page, bytes: a list of a few hundred lassos of [`MAX_POINTS`], 64 kB each; other requests take a few
/// hundred.
pub const MAX_REQUEST: usize = 16 << 20;
/// Maximum number of corners of a polygon or points of a stroke.
pub const MAX_POINTS: usize = 2000;
/// Maximum number of steps in one request to select.
const MAX_STEPS: usize = 8;
/// Largest side of a picture, pixels.
pub const MAX_SIDE: u32 = 4096;
/// Largest number of pixels of a picture; larger windows get a smaller picture, scaled by the browser.
pub const MAX_PIXELS: f32 = 2.6e6;

/// What is drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Colours.
    #[default]
    Color,
    /// Expected depth in a colour map.
    Depth,
    /// Coverage.
    Alpha,
    /// Normals in the world.
    Normals,
    /// Splats per pixel.
    Count,
    /// Splats as opaque ellipses.
    Ellipses,
    /// Splats as rings.
    Rings,
    /// Splats as points.
    Points,
    /// The absolute difference to the photograph of `view`.
    Error,
}

/// A picture that a page wants, not validated.
#[derive(Clone, Debug, Deserialize)]
pub struct RawShot {
    /// Chosen by the page, increasing.
    pub id: u64,
    position: [f32; 3],
    /// World from camera (x right, y down, z forward): w, x, y, z.
    rotation: [f32; 4],
    width: u32,
    height: u32,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    #[serde(default)]
    mode: Mode,
    #[serde(default)]
    background: Option<[f32; 3]>,
    #[serde(default)]
    clip: Option<[[f32; 3]; 2]>,
    #[serde(default)]
    view: Option<usize>,
    #[serde(default)]
    highlight: bool,
    #[serde(default)]
    light: Option<usize>,
}

/// A picture that a page wants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// As in the request.
    pub id: u64,
    /// At the size of the page's window.
    pub camera: Camera,
    /// What is drawn.
    pub mode: Mode,
    /// Background colour, sRGB; the scene's own if `None`.
    pub background: Option<[f32; 3]>,
    /// Only splats with centres in this box (minimum, maximum; world) are drawn.
    pub clip: Option<[[f32; 3]; 2]>,
    /// The view whose photograph errors are measured against.
    pub view: Option<usize>,
    /// Whether selected splats are tinted.
    pub highlight: bool,
    /// The view in whose light colours are shown; the mean light if `None`.
    pub light: Option<usize>,
}

impl RawShot {
    /// `None` for anything that cannot be drawn.
    pub fn check(&self) -> Option<Shot> {
        let [w, x, y, z] = self.rotation;
        let rotation = Quat::from_xyzw(x, y, z, w);
        let mut intrinsics = Intrinsics::from_fov_x(self.width.max(1), self.height.max(1), 1.0);
        (intrinsics.fx, intrinsics.fy) = (self.fx, self.fy);
        (intrinsics.cx, intrinsics.cy) = (self.cx, self.cy);
        let pose = Pose {
            rotation: rotation.normalize(),
            position: Vec3::from_array(self.position),
        };
        let is_drawable = (1..=MAX_SIDE).contains(&self.width)
            && (1..=MAX_SIDE).contains(&self.height)
            && rotation.length_squared() > 1e-12
            && pose.is_valid()
            && intrinsics.is_valid();
        let color = |c: &[f32; 3]| c.iter().all(|v| (0.0..=1.0).contains(v));
        let extent = |c: &[[f32; 3]; 2]| c.as_flattened().iter().all(|v| !v.is_nan());
        let is_drawable = is_drawable && self.background.as_ref().is_none_or(color);
        (is_drawable && self.clip.as_ref().is_none_or(extent)).then(|| Shot {
            id: self.id,
            camera: Camera::new(pose, intrinsics),
            mode: self.mode,
            background: self.background,
            clip: self.clip,
            view: self.view,
            highlight: self.highlight,
            light: self.light,
        })
    }
}

/// What the training should do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Action {
    /// Pause after the current step.
    Pause,
    /// Resume after a pause.
    Resume,
    /// One step, then pause.
    Step,
    /// Write a checkpoint.
    Save,
    /// Stop and finish: evaluate and write the report.
    Stop,
}

/// A request of a page.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub enum Request {
    /// Draw this until told otherwise.
    Shot(RawShot),
    /// The page draws its own pictures: none are needed.
    Rest,
    /// The picture `id` is on the screen.
    Shown {
        /// As in the picture's header.
        id: u64,
    },
    /// What is at `(x, y)`, pixels, of this picture?
    Pick {
        /// Column.
        x: f32,
        /// Row.
        y: f32,
        /// Chosen by the page, repeated in the answer.
        tag: String,
        /// The picture.
        shot: RawShot,
    },
    /// Measure the PSNR of every view.
    Scores,
    /// Control the training.
    Train {
        /// What it should do.
        action: Action,
    },
    /// Keep the length of the world's unit in the run.
    Unit {
        /// Metres per world unit of the scene as it was opened.
        metres: f64,
    },
    /// Edit the scene.
    #[serde(untagged)]
    Edit(EditRequest),
}

/// An edit request of a page. Positions and lengths are those of the world in which the page draws.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub enum EditRequest {
    /// Change the selection.
    Select {
        /// A request of the same gesture as the one before replaces it.
        #[serde(default)]
        gesture: u64,
        /// Whether the previous selection is discarded.
        #[serde(default)]
        replace: bool,
        /// Applied one after the other.
        steps: Vec<SelectStep>,
    },
    /// Select nothing.
    Deselect,
    /// Edit the selected splats.
    Edit {
        /// A request of the same gesture as the one before replaces it.
        #[serde(default)]
        gesture: u64,
        /// Whether to edit the whole scene instead.
        #[serde(default)]
        whole: bool,
        /// The operation.
        edit: Operation,
    },
    /// Make the edits of a list.
    Replay {
        /// `edits.toml`.
        list: String,
    },
    /// Undo the last selection or edit.
    Undo,
    /// Redo what was undone last.
    Redo,
    /// Undo or redo entries until the first `at` of the list are made.
    Go {
        /// Their number.
        at: usize,
    },
    /// Show the scene as it was opened, or as it is.
    Compare {
        /// As it was opened.
        before: bool,
    },
    /// Write list and scene beside the scene's file.
    Save,
}

impl EditRequest {
    /// The gesture by which requests replace each other.
    pub fn gesture(&self) -> Option<u64> {
        match self {
            Self::Select { gesture, .. } | Self::Edit { gesture, .. } => Some(*gesture).filter(|gesture| *gesture != 0),
            _ => None,
        }
    }

    /// Whether the request has positions or directions, which a page takes from the picture that it shows.
    pub fn is_placed(&self) -> bool {
        match self {
            Self::Select { steps, .. } => steps.iter().any(|step| {
                matches!(
                    step.shape,
                    Shape::Box { .. }
                        | Shape::Sphere { .. }
                        | Shape::HalfSpace { .. }
                        | Shape::Polygon { .. }
                        | Shape::Brush { .. }
                )
            }),
            Self::Edit { edit, .. } => matches!(
                edit,
                Operation::Move { .. }
                    | Operation::Rotate { .. }
                    | Operation::Scale { .. }
                    | Operation::SetLength { .. }
                    | Operation::Upright { up: Some(_), .. }
            ),
            _ => false,
        }
    }

    /// Whether every number is in range.
    ///
    /// # Errors
    /// One line that names the number.
    pub fn check(&self) -> Result<(), EditError> {
        match self {
            Self::Select { steps, .. } => {
                if !(1..=MAX_STEPS).contains(&steps.len()) {
                    return Err(EditError::Selection(format!(
                        "a request to select has 1 to {MAX_STEPS} steps"
                    )));
                }
                if steps.iter().any(|step| points(step) > MAX_POINTS) {
                    return Err(EditError::Selection(format!(
                        "a selection step has at most {MAX_POINTS} points"
                    )));
                }
                steps.iter().try_for_each(SelectStep::check)
            }
            Self::Replay { list } => EditList::parse(list).map(drop),
            Self::Edit { whole, edit, .. } => {
                let edit = Edit {
                    op: edit.clone(),
                    select: (!whole).then(Vec::new),
                };
                edit.check()
            }
            _ => Ok(()),
        }
    }
}

/// Points that a step draws.
fn points(step: &SelectStep) -> usize {
    match &step.shape {
        Shape::Polygon { points, .. } | Shape::Brush { points, .. } => points.len(),
        _ => 0,
    }
}

/// Header of a picture.
#[derive(Clone, Debug, Serialize)]
pub struct PictureHeader {
    /// Of the shot.
    pub id: u64,
    /// Pixels of the JPEG.
    pub width: u32,
    /// Pixels of the JPEG.
    pub height: u32,
    /// Whether no better picture follows.
    pub sharp: bool,
    /// Version of the scene.
    pub version: u64,
    /// Milliseconds of drawing and encoding.
    pub milliseconds: f32,
    /// Values at both ends of the colour map, if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range: Option<[f32; 2]>,
}

/// A picture as a binary message.
pub fn picture(header: &PictureHeader, jpeg: &[u8]) -> Vec<u8> {
    let header = serde_json::to_vec(header).expect("plain data");
    let mut bytes = Vec::with_capacity(4 + header.len() + jpeg.len());
    bytes.extend((header.len() as u32).to_le_bytes());
    bytes.extend(header);
    bytes.extend(jpeg);
    bytes
}

/// What was picked.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Picked {
    /// Of the request.
    pub tag: String,
    /// Where the ray meets the surface: half of the light comes from in front of it. World; `None` if there is nothing.
    pub point: Option<[f32; 3]>,
    /// Its depth along the camera's +Z, world units.
    pub depth: Option<f32>,
    /// The splat with the largest share of the pixel, if splats are drawn.
    pub splat: Option<PickedSplat>,
}

/// A splat and its contribution to a pixel.
#[derive(Clone, Debug, Serialize)]
pub struct PickedSplat {
    /// Index in the file.
    pub index: u32,
    /// Number of splats that contribute to the pixel.
    pub of: usize,
    /// World.
    pub mean: [f32; 3],
    /// Standard deviations, world units, largest first.
    pub scales: [f32; 3],
    /// In (0, 1).
    pub opacity: f32,
    /// sRGB, as seen from here.
    pub color: [f32; 3],
    /// sRGB, without what depends on the direction.
    pub base: [f32; 3],
    /// Along the camera's +Z, world units.
    pub depth: f32,
    /// Share of the pixel's colour.
    pub weight: f32,
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHOT: &str = r#"{"do":"shot","id":1,"position":[0,0,0],"rotation":[2,0,0,0],
        "width":40,"height":30,"fx":30,"fy":30,"cx":20,"cy":15,"mode":"depth"}"#;

    fn shot(text: &str) -> Option<Shot> {
        match serde_json::from_str(text) {
            Ok(Request::Shot(raw)) => raw.check(),
            _ => None,
        }
    }

    #[test]
    fn a_shot_is_read_and_its_rotation_normalised() {
        let shot = shot(SHOT).expect("a shot");
        assert_eq!((shot.mode, shot.camera.intrinsics.height), (Mode::Depth, 30));
        assert!((shot.camera.pose.rotation.length() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn what_cannot_be_drawn_is_refused() {
        for (from, to) in [
            ("\"width\":40", "\"width\":0"),
            ("\"width\":40", "\"width\":99999"),
            ("\"width\":40", "\"width\":-1"),
            ("\"fx\":30", "\"fx\":0"),
            ("\"fx\":30", "\"fx\":1e39"),
            ("[2,0,0,0]", "[0,0,0,0]"),
            ("[0,0,0]", "[0,0]"),
            ("\"depth\"", "\"x-ray\""),
            ("\"mode\":\"depth\"", "\"background\":[0,0,7]"),
        ] {
            assert!(shot(&SHOT.replacen(from, to, 1)).is_none(), "{to}");
        }
    }
}
