//! What a small field adds to the splats' colours, by place and direction of view.

use crate::recipe::Param;
use crate::schedule::StepPlan;
use crate::trainer::{TrainError, Trainer};
use glam::Vec3;
use irradia_field::{Field, FieldState, Sampler, Sight, Space, StepOptions, residual_at, train_residual};
use irradia_scene::{Camera, sh};
use irradia_splat::{RenderOptions, Renderer, Splats, ViewParams};

/// Stream of the run's seed.
const STREAM_RESIDUAL: u64 = 8;

/// How `field` is asked about the splats `seen` from `center`.
fn sights(field: &Field, splats: &Splats, center: Vec3, seen: &[u32]) -> Vec<Sight> {
    let mirrored = matches!(field.config.sampler, Sampler::Given { mirrored: true });
    let sight = |i: &u32| {
        let i = *i as usize;
        let mean = Vec3::from(splats.mean(i));
        let view = (mean - center).normalize_or_zero();
        let direction = if mirrored {
            let normal = Vec3::from(splats.shortest_axis(i));
            view - 2.0 * view.dot(normal) * normal
        } else {
            view
        };
        Sight {
            point: mean.to_array(),
            direction: direction.to_array(),
        }
    };
    seen.iter().map(sight).collect()
}

/// Renders `splats` as `camera` sees them, with what `residual` adds.
pub(crate) fn render(
    renderer: &mut Renderer,
    splats: &Splats,
    residual: Option<&Field>,
    camera: &Camera,
    options: &RenderOptions,
) {
    let view = ViewParams::new(camera);
    match residual {
        Some(field) => {
            let shade = |seen: &[u32]| residual_at(field, &sights(field, splats, camera.pose.position, seen));
            renderer.render_shaded(splats, &view, options, Some(&shade));
        }
        None => renderer.render(splats, &view, options),
    }
}

/// The field that adds to what `plan` renders, if one does. Once it has begun it stays.
pub(crate) fn in_force<'a>(state: &'a Option<FieldState>, plan: &StepPlan) -> Option<&'a Field> {
    let state = state.as_ref()?;
    (plan.is_on(Param::Residual) || state.step > 0).then_some(&state.field)
}

impl Trainer {
    /// The recipe's residual field, which adds nothing yet; none where the recipe has none.
    pub(crate) fn first_residual(&mut self) -> Result<Option<FieldState>, TrainError> {
        let Some(knobs) = self.recipe.residual.clone() else {
            return Ok(None);
        };
        let transparent = self.transparent()?;
        let space = Space::around(&self.train_cameras(), !transparent).ok_or(TrainError::NoSpace)?;
        let seed = self.options.seed ^ STREAM_RESIDUAL << 40;
        let field = Field::residual(knobs.net, knobs.mirrored, space, seed)?;
        Ok(Some(FieldState::new(field)))
    }

    /// One step of the residual field after a frame's backward; the splats must be those that were rendered.
    pub(crate) fn train_residual(&mut self, plan: &StepPlan, camera: &Camera) {
        let (Some(_), Some(knobs)) = (in_force(&self.residual, plan), &self.recipe.residual) else {
            return;
        };
        let planes = [0, 1, 2].map(|c| self.gradients.splats.sh.plane(c));
        let v_of = |i: u32| planes.map(|plane| plane[i as usize] / sh::C0 as f32);
        // What hides behind others has no gradient, and is most of what is in view.
        let seen: Vec<u32> = self
            .renderer
            .in_view()
            .iter()
            .copied()
            .filter(|i| self.gradients.active[*i as usize] > 0.0 && v_of(*i) != [0.0; 3])
            .collect();
        let v_added: Vec<[f32; 3]> = seen.iter().map(|i| v_of(*i)).collect();
        let options = StepOptions {
            table_rate: plan.value(Param::RateTables),
            net_rate: plan.value(Param::RateNets),
            beta2: knobs.beta2,
            ..StepOptions::default()
        };
        let state = self.residual.as_mut().expect("asked for above");
        let sights = sights(&state.field, &self.state.splats, camera.pose.position, &seen);
        train_residual(state, &sights, &v_added, &options);
    }
}
