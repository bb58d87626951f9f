//! Parameters for data that show where space is empty.
//!
//! A scene that begins with splats at random positions needs pressure on opacities, since what floats before the cameras fades only under
//! it. Where points show the surfaces, or alpha what is empty, the same pressure makes surfaces transparent.

use crate::first_splats::has_points;
use crate::trainer::{TrainError, Trainer};

impl Trainer {
    /// Puts the recipe's parameters for known space into effect if the data show it. In the recipe, so that a resumed run has the same.
    pub(crate) fn settle_known_space(&mut self) -> Result<(), TrainError> {
        let params = std::mem::take(&mut self.recipe.known_space);
        if params.is_empty() {
            return Ok(());
        }
        let why = if has_points(&self.dataset) {
            "points show the surfaces"
        } else if self.transparent()? {
            "alpha shows the empty space"
        } else {
            return Ok(());
        };
        let names: Vec<&str> = params.keys().map(|param| param.name()).collect();
        self.decisions
            .push(format!("{why}: {} as in [known_space] of the recipe", names.join(", ")));
        self.recipe.params.extend(params);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use crate::Recipe;
    use crate::recipe::{Knob, Param};
    use crate::trainer::{TrainOptions, Trainer};
    use glam::Vec3;
    use irradia_scene::{Camera, Dataset, Intrinsics, Photo, PointCloud, Pose, View};
    use std::sync::Arc;

    /// One grey photograph of `channels` channels, with or without points.
    fn dataset(channels: u32, points: bool) -> Arc<Dataset> {
        let view = View {
            name: "a".into(),
            camera: Camera::new(
                Pose::look_at(Vec3::NEG_Z, Vec3::ZERO, Vec3::NEG_Y),
                Intrinsics::from_fov_x(8, 8, 1.0),
            ),
            photo: Arc::new(Photo {
                width: 8,
                height: 8,
                channels,
                data: vec![128; 64 * channels as usize],
                mask: None,
            }),
            depth_bounds: None,
            time: None,
            points_seen: Vec::new(),
        };
        let positions: Vec<Vec3> = (0..12).map(|i| Vec3::new(0.1 * i as f32, 0.0, 1.0)).collect();
        Arc::new(Dataset {
            views: vec![view],
            train: vec![0],
            points: points.then(|| PointCloud {
                colors: vec![[128; 3]; positions.len()],
                positions,
            }),
            ..Dataset::default()
        })
    }

    #[test]
    fn parameters_for_known_space_hold_where_points_or_alpha_show_it() {
        let trained = |channels, points, set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).to_owned()).collect();
            let recipe = Recipe::parse("fast", Recipe::built_in("fast").unwrap(), &set).unwrap();
            let usual = recipe.params[&Param::OpacityReg].clone();
            let given = recipe.known_space.get(&Param::OpacityReg).cloned();
            let trainer = Trainer::new(dataset(channels, points), recipe, TrainOptions::default()).unwrap();
            assert!(trainer.recipe.known_space.is_empty(), "settled");
            let told = trainer.decisions.iter().any(|line| line.contains("opacity_reg"));
            let value = trainer.recipe.params[&Param::OpacityReg].clone();
            assert_eq!(told, value != usual);
            (value, usual, given)
        };
        for (channels, points) in [(3, true), (4, false), (4, true)] {
            let (value, _, given) = trained(channels, points, &[]);
            assert_eq!(Some(value), given, "{channels} {points}");
        }
        let (value, usual, _) = trained(3, false, &[]);
        assert_eq!(value, usual);
        for set in ["params.opacity_reg=0.5", "params.opacity_reg = 0.5"] {
            let (value, ..) = trained(3, true, &[set]);
            assert_eq!(value, Knob::Const(0.5), "what is set prevails");
        }
        let (value, ..) = trained(3, true, &["known_space.opacity_reg=0.3"]);
        assert_eq!(value, Knob::Const(0.3));
    }
}
