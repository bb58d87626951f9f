//! Examines all training views during a run: which photographs do not fit the others, and what only one of them shows.

use crate::event::Event;
use crate::robust::median;
use crate::schedule::{StepPlan, plan};
use crate::trainer::{TrainError, Trainer};
use crate::transients::{Difference, Hidden};
use irradia_scene::Pose;
use irradia_splat::FramePlanes;

/// Fraction of a run after which misfits are left out.
const MISFITS_AT: f64 = 0.2;
/// Fractions of a run after which transients are hidden. At 0.2, surfaces at the border of a scene are not learned yet and are taken for
/// transients; the later searches find the borders of what the first one found.
const TRANSIENTS_AT: [f64; 3] = [0.3, 0.45, 0.6];
/// Size of the renders for an audit, relative to the photographs: errors are averaged over blocks or the whole photograph.
const AUDIT_SCALE: f32 = 0.5;
/// Minimum number of a run's steps per training view for a decision on every view: with fewer, the renders would cost more than a twentieth
/// of the run.
const MIN_STEPS_PER_VIEW: f64 = 8.0;
/// Cost of a render in steps of the same size: without a loss and a backward pass.
const RENDER_STEPS: f64 = 0.4;
/// Number of renders whose median is the time of a render; the first one includes that for buffers.
const TIMED_RENDERS: usize = 5;

/// The `count` of `others` whose poses are nearest to `pose`, nearest first. A move by `unit` counts as much as a turn by one radian.
pub(crate) fn nearest<T>(pose: &Pose, others: impl Iterator<Item = (Pose, T)>, count: usize, unit: f32) -> Vec<T> {
    let mut near: Vec<(f32, T)> = others.map(|(other, of)| (pose.distance(&other, unit), of)).collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    near.truncate(count);
    near.into_iter().map(|(_, of)| of).collect()
}

impl Trainer {
    /// Does what is due after a step that began at `before`, in steps of the recipe: leaves out misfits, hides transients.
    pub(crate) fn audit(&mut self, before: f64) -> Result<Vec<Event>, TrainError> {
        let mut events = Vec::new();
        if !self.can_render_all_views(AUDIT_SCALE) {
            return Ok(events);
        }
        if self.recipe.drop_misfits && self.passes(before, MISFITS_AT) {
            let errors = self.training_errors()?;
            events.extend(self.leave_out_misfits(&errors));
        }
        if self.recipe.hide_transients && TRANSIENTS_AT.into_iter().any(|at| self.passes(before, at)) {
            // If the first search finds nothing, there are no later ones.
            let is_first = self.passes(before, TRANSIENTS_AT[0]);
            if is_first || self.hidden.views() > 0 {
                self.find_transients()?;
            }
            events.extend((is_first && self.hidden.views() > 0).then(|| self.hidden_event()));
        }
        Ok(events)
    }

    /// Number of steps of full size that take as long as the audits still to come.
    pub(crate) fn audit_steps(&self) -> f64 {
        if self.field.is_some() || !self.can_render_all_views(AUDIT_SCALE) {
            return 0.0;
        }
        let ahead = |at: f64| self.clock.time < at * self.recipe.total_steps() as f64;
        let is_searched = |at: &f64| ahead(*at) && (*at == TRANSIENTS_AT[0] || self.hidden.views() > 0);
        let searches = TRANSIENTS_AT
            .iter()
            .filter(|at| self.recipe.hide_transients && is_searched(at));
        let audits = searches.count() + usize::from(self.recipe.drop_misfits && ahead(MISFITS_AT));
        RENDER_STEPS * f64::from(AUDIT_SCALE * AUDIT_SCALE) * (audits * self.trained.len()) as f64
    }

    /// How many steps of full size take `seconds`, by the time of a few renders.
    pub(crate) fn steps_within(&mut self, seconds: f64) -> Result<f64, TrainError> {
        let plan = StepPlan {
            image_scale: 1.0,
            ..plan(&self.recipe, &self.clock)
        };
        let views: Vec<usize> = self.trained.iter().copied().take(TIMED_RENDERS).collect();
        let mut renders = Vec::with_capacity(views.len());
        for view in views {
            let before = self.seconds;
            self.render_training_views(&[view], &plan, false, |_, _, _| {})?;
            renders.push(self.seconds - before);
        }
        Ok(RENDER_STEPS * seconds / median(renders))
    }

    /// The plan of the renders for an audit.
    fn audit_plan(&self) -> StepPlan {
        let plan = plan(&self.recipe, &self.clock);
        StepPlan {
            image_scale: plan.image_scale.min(AUDIT_SCALE),
            ..plan
        }
    }

    /// Whether the step that began at `before`, in steps of the recipe, passed the fraction `at` of the run. The first step passes all that
    /// were skipped.
    pub(crate) fn passes(&self, before: f64, at: f64) -> bool {
        let at = at * self.recipe.total_steps() as f64;
        (before < at || self.clock.step == 1) && self.clock.time >= at
    }

    /// Whether the run is long enough to render every training view once more, at `image_scale`.
    pub(crate) fn can_render_all_views(&self, image_scale: f32) -> bool {
        let cost = f64::from(image_scale * image_scale) * self.trained.len() as f64;
        self.total_steps() as f64 >= MIN_STEPS_PER_VIEW * cost
    }

    /// The error of each training view over all pixels, and over the pixels that fit best.
    fn training_errors(&mut self) -> Result<Vec<(usize, [f64; 2])>, TrainError> {
        let plan = self.audit_plan();
        let mut errors = Vec::with_capacity(self.trained.len());
        self.render_training_views(&self.trained.clone(), &plan, false, |trainer, view, photo| {
            errors.push((view, trainer.frame_errors(photo)));
        })?;
        Ok(errors)
    }

    /// Hides what only one photograph shows.
    fn find_transients(&mut self) -> Result<(), TrainError> {
        let plan = self.audit_plan();
        let mut differences = Vec::with_capacity(self.trained.len());
        self.render_training_views(&self.trained.clone(), &plan, true, |trainer, view, photo| {
            let frame = FramePlanes {
                color: trainer.sockets.frame_color(&trainer.engine),
                ..trainer.engine.frame()
            };
            let camera = trainer.camera(view);
            differences.push((view, Difference::new(&frame, photo, &camera, trainer.extent)));
        })?;
        self.hidden = Hidden::find(&differences, self.length_unit, &self.hidden);
        Ok(())
    }

    fn hidden_event(&self) -> Event {
        let (views, share) = (self.hidden.views(), 100.0 * self.hidden.share());
        let message = format!(
            "{views} of {} photographs show what the others do not (people, cars, shadows), on average {share:.0} % of each; it is hidden from training (--set hide_transients=false shows it)",
            self.trained.len()
        );
        Event::Decided { message }
    }
}
