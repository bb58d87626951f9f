//! Edits of splat scenes as data.
//!
//! An [`Edit`] is an [`Operation`] on the splats that its [`SelectStep`]s select; an [`EditList`] is the content of `edits.toml`. All
//! positions are in the dataset's coordinates, so that a list can be replayed on a retrained scene. A [`Draft`] is the scene being
//! edited; [`select`] evaluates a selection on it, [`apply`] applies an edit, [`History`] applies and undoes edits.
//!
//! ```
//! use irradia_edit::{Draft, Edit, apply, open_nothing, select};
//! # use irradia_scene::GaussianCloud;
//! # let cloud = GaussianCloud {
//! #     means: vec![[0.0; 3], [5.0, 0.0, 0.0]], quats: vec![[1.0, 0.0, 0.0, 0.0]; 2], log_scales: vec![[-1.0; 3]; 2],
//! #     opacity_logits: vec![4.0; 2], sh: vec![1.0; 6], ..Default::default()
//! # };
//!
//! let mut draft = Draft::new(cloud, Vec::new());
//! let edit: Edit = "delete sphere center=5,0,0 radius=1".parse()?;
//! assert_eq!(select(&draft, edit.select.as_deref().unwrap())?.count(), 1);
//! let applied = apply(&mut draft, &edit, &open_nothing)?;
//! assert_eq!((draft.len(), applied.provenance.source(0)), (1, Some(0)));
//! # Ok::<(), irradia_edit::EditError>(())
//! ```
#![forbid(unsafe_code)]

mod color;
mod draft;
mod error;
mod floaters;
mod ground;
mod harmonics;
mod history;
mod list;
mod opacity_fit;
mod photographs;
mod plan;
mod select;
mod selection;
mod shape;
mod subject;
mod text;
mod transform;
mod visibility;

pub use draft::Draft;
pub use error::EditError;
pub use floaters::{FloaterScores, floater_scores};
pub use ground::{Ground, ground};
pub use history::History;
pub use list::{Edit, EditList, Operation, UpAxis};
pub use photographs::{LoadedPhotographs, Photographs};
pub use plan::{Applied, OpenScene, Provenance, apply, apply_to, open_nothing};
pub use select::select;
pub use selection::Selection;
pub use shape::{Mode, SelectStep, Shape, Viewpoint};
pub use subject::subject;
pub use transform::Transform;
