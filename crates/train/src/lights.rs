//! The light of each photograph as a run has learned it, to render the scene in the light of one of its photographs.

use crate::TrainError;
use crate::field_file;
use crate::socket::{Appearance, Exposure, Sockets, lit_colors};
use glam::Vec3;
use irradia_field::{Field, Sampler};
use irradia_splat::Surface;
use std::borrow::Cow;
use std::fmt::Display;

/// How photographs differ from the scene in its mean light: their exposures, and the colours that their appearance codes add. A sky and a
/// bilateral grid belong to a photograph's own frame and are not included.
#[derive(Clone, Debug)]
pub struct Lights {
    exposures: Option<Exposure>,
    appearance: Option<Field>,
}

/// The light of one photograph.
#[derive(Clone, Copy, Debug)]
pub struct Light<'a> {
    lights: &'a Lights,
    view: usize,
}

impl Lights {
    /// The lights of a training; `None` if it has not learned any.
    pub fn of_training(sockets: &Sockets) -> Option<Self> {
        let appearance = sockets.appearance.as_ref().and_then(Appearance::trained_field).cloned();
        let lights = Self {
            exposures: sockets.exposure.clone(),
            appearance,
        };
        (lights.views() > 0).then_some(lights)
    }

    /// From the files that a run writes beside its scene, exposures and appearance codes; `None` if there are none.
    ///
    /// # Errors
    /// If a file is damaged, or the two are for different numbers of photographs.
    pub fn from_files(exposures: Option<&[u8]>, appearance: Option<&[u8]>) -> Result<Option<Self>, TrainError> {
        let damaged = |what: &str, why: &dyn Display| TrainError::Checkpoint(format!("{what}: {why}"));
        let exposures = exposures.map(Exposure::from_file).transpose();
        let exposures = exposures.map_err(|why| damaged("exposures", &why))?;
        let appearance = appearance.map(field_file::from_bytes).transpose();
        let appearance = appearance.map_err(|why| damaged("appearance codes", &why))?;
        if let Some(field) = &appearance
            && (!matches!(field.config.sampler, Sampler::Given { .. }) || field.config.images == 0)
        {
            return Err(TrainError::Checkpoint("the field has no appearance codes".into()));
        }
        if let (Some(exposures), Some(field)) = (&exposures, &appearance)
            && exposures.views() != field.config.images
        {
            return Err(TrainError::Checkpoint(format!(
                "exposures for {} photographs, but appearance codes for {}",
                exposures.views(),
                field.config.images
            )));
        }
        let lights = Self { exposures, appearance };
        Ok((lights.views() > 0).then_some(lights))
    }

    /// Number of photographs: all views of the dataset, of which only training views have a light of their own.
    pub fn views(&self) -> usize {
        let images = self.appearance.as_ref().map_or(0, |field| field.config.images);
        self.exposures.as_ref().map_or(images, Exposure::views)
    }

    /// The light of view `view` of the dataset; `None` if there is no such view.
    pub fn of_view(&self, view: usize) -> Option<Light<'_>> {
        (view < self.views()).then_some(Light { lights: self, view })
    }
}

impl Light<'_> {
    /// Whether this light adds colours to splats.
    pub(crate) fn adds_colors(&self) -> bool {
        self.lights.appearance.is_some()
    }

    /// The colours to add to `surfaces` seen from `center`, world; `None` without appearance codes.
    pub(crate) fn added_colors(&self, center: Vec3, surfaces: &[Surface]) -> Option<Vec<[f32; 3]>> {
        let field = self.lights.appearance.as_ref()?;
        Some(lit_colors(field, self.view, center, surfaces))
    }

    /// Applies the photograph's exposure to the frame `color` `[3, H, W]`, which [`render_splats`](crate::model::render_splats) rendered in
    /// this light.
    pub fn exposed<'c>(&self, color: &'c [f32]) -> Cow<'c, [f32]> {
        let Some(exposures) = &self.lights.exposures else {
            return Cow::Borrowed(color);
        };
        let mut exposed = Vec::new();
        exposures.apply(self.view, color, &mut exposed);
        Cow::Owned(exposed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::tests::dataset;
    use crate::model::{Model, render_splats};
    use crate::recipe::Recipe;
    use crate::schedule::plan;
    use crate::socket::Occupant;
    use crate::trainer::{TrainOptions, Trainer};
    use irradia_splat::Renderer;

    fn assert_close(a: &[f32], b: &[f32], tolerance: f32) {
        assert_eq!(a.len(), b.len());
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < tolerance));
    }

    #[test]
    fn exposures_come_back_from_their_file() {
        let exposure = Exposure::new(3, &[0, 2]).with_gains(&[(0, 0.2), (2, -0.2)]);
        let file = exposure.export().expect("exposures are always written");
        let lights = Lights::from_files(Some(&file), None).unwrap().expect("lights");
        assert_eq!(lights.views(), 3);
        let color = [0.2, 0.4, 0.6];
        for view in 0..3 {
            let mut expected = Vec::new();
            exposure.apply(view, &color, &mut expected);
            assert_eq!(*lights.of_view(view).unwrap().exposed(&color), expected);
        }
        assert_ne!(*lights.of_view(0).unwrap().exposed(&color), color);
        assert!(lights.of_view(3).is_none());
    }

    #[test]
    fn a_scene_in_the_light_of_a_photograph_is_the_frame_of_its_steps() {
        let overrides = ["exposure=true", "params.rate_codes=0.05"].map(str::to_owned);
        let recipe = Recipe::parse("shiny", Recipe::built_in("shiny").unwrap(), &overrides).unwrap();
        let mut trainer = Trainer::new(dataset(), recipe, TrainOptions::default()).unwrap();
        for _ in 0..4 {
            trainer.step(&mut Vec::new()).unwrap();
        }
        let files = trainer.sockets.files();
        let file = |name: &str| files.iter().find(|file| file.0 == name).map(|file| &file.1[..]);
        let read = Lights::from_files(file("exposure.safetensors"), file("appearance.safetensors")).unwrap();
        let options = trainer.render_options(0);
        let plan = plan(&trainer.recipe, &trainer.clock);
        for lights in [Lights::of_training(&trainer.sockets), read].map(Option::unwrap) {
            for view in 0..2 {
                let camera = trainer.camera(view);
                let (splats, residual) = match trainer.scene() {
                    Model::Splats { splats, residual } => (splats.into_owned(), residual),
                    Model::Field(_) => unreachable!("shiny trains splats"),
                };
                let mut renderer = Renderer::new();
                let light = lights.of_view(view);
                render_splats(&splats, residual.as_deref(), light, &mut renderer, &camera, &options);
                let drawn = light.unwrap().exposed(renderer.color()).into_owned();
                let (sockets, engine) = (&mut trainer.sockets, &mut trainer.engine);
                sockets.render(engine, view, camera.into(), &options, &plan);
                assert_close(&drawn, sockets.frame_color(engine), 1e-5);
                render_splats(&splats, residual.as_deref(), None, &mut renderer, &camera, &options);
                assert_ne!(drawn, renderer.color(), "the mean light is different");
            }
        }
    }

    #[test]
    fn what_is_no_light_is_refused() {
        assert!(Lights::from_files(None, None).unwrap().is_none());
        for bytes in [&b""[..], b"{}", &[0; 40]] {
            assert!(Lights::from_files(Some(bytes), None).is_err());
            assert!(Lights::from_files(None, Some(bytes)).is_err());
        }
        let other = crate::tensor_file::to_bytes(
            &[crate::tensor_file::NamedTensor::f32s("maps", vec![5], &[0.0; 5])],
            ("x", "1".into()),
        );
        let error = Lights::from_files(Some(&other), None).unwrap_err().to_string();
        assert!(error.contains("maps"), "{error}");
    }
}
