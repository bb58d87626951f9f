//! Photographs that do not fit what the others agree on: wrong poses, or another scene.
//!
//! After the first fifth of a run the splats show what most photographs have in common, and have not yet adapted to the others. A
//! photograph whose error is far beyond the usual spread of errors is then left out: what splats would do to fit it, in the place that it
//! shows or elsewhere, harms every other view. Natural differences of errors (texture, depth of field, views at the border of the scene)
//! stay below [`MIN_FACTOR`], or widen the spread.

use crate::event::Event;
use crate::robust::{median, spread};
use crate::trainer::Trainer;

/// Minimum number of training views for a decision.
const MIN_VIEWS: usize = 8;
/// Number of standard deviations of the ln errors above their median beyond which a photograph is a misfit: five wrong poses of fifty were
/// at 7 to 9 (of the ln squared errors), the most unusual photographs of seven captures at 1.2 to 4.
const MIN_DEVIATIONS: f64 = 5.0;
/// Minimum factor of a misfit's error over the median: the wrong poses had 3.5 to 5.4, and a photograph with a correct pose has had 2.1.
const MIN_FACTOR: f64 = 2.5;
/// Minimum factor over the median of a misfit's error over the pixels that fit best.
const MIN_TRIMMED_FACTOR: f64 = 1.5;
/// Maximum fraction of misfits: with more of them it is not clear which photographs are wrong.
const MAX_MISFIT_FRACTION: f64 = 0.2;

/// The views whose `errors` are far beyond the others' spread, and the factors of these over the median, worst first.
fn outliers(errors: &[(usize, f64)]) -> Vec<(usize, f64)> {
    let logs: Vec<f64> = errors.iter().map(|(_, error)| error.max(1e-9).ln()).collect();
    if logs.len() < MIN_VIEWS {
        return Vec::new();
    }
    let middle = median(logs.clone());
    let threshold = (MIN_DEVIATIONS * spread(logs.iter().map(|log| log - middle))).max(MIN_FACTOR.ln());
    let excess = errors
        .iter()
        .map(|(view, error)| (*view, error.max(1e-9).ln() - middle));
    let mut found: Vec<(usize, f64)> = excess.filter(|(_, excess)| *excess > threshold).collect();
    found.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    found.iter().map(|(view, excess)| (*view, excess.exp())).collect()
}

/// The views whose error over all pixels is far beyond the others', and whose error over the pixels that fit best is beyond the others' as
/// well: a person in front of the camera makes a part of a photograph worse, a wrong pose all of it.
fn misfits(errors: &[(usize, [f64; 2])]) -> Vec<(usize, f64)> {
    let all: Vec<(usize, f64)> = errors.iter().map(|(view, [all, _])| (*view, *all)).collect();
    let mut found = outliers(&all);
    if !found.is_empty() {
        let threshold = MIN_TRIMMED_FACTOR * median(errors.iter().map(|(_, [_, best])| *best).collect());
        found.retain(|(misfit, _)| {
            errors
                .iter()
                .any(|(view, [_, best])| view == misfit && *best > threshold)
        });
    }
    found
}

impl Trainer {
    /// Trains on the views `trained` only from now on. What the others show, and where they stand, is no evidence of empty space any more.
    pub(crate) fn train_on(&mut self, trained: Vec<usize>) {
        let views = trained.iter().copied().collect();
        self.free_space.keep(&views);
        if let Some(surroundings) = &mut self.surroundings {
            surroundings.keep(&views);
        }
        self.trained = trained;
    }

    /// Leaves out the photographs whose `errors`, over all pixels and over those that fit best, are misfits, and reports their names.
    pub(crate) fn leave_out_misfits(&mut self, errors: &[(usize, [f64; 2])]) -> Option<Event> {
        let found = misfits(errors);
        if found.is_empty() {
            return None;
        }
        let names: Vec<String> = found
            .iter()
            .map(|(view, factor)| format!("{} ({factor:.1} times the usual error)", self.dataset.views[*view].name))
            .collect();
        let (names, n, count) = (names.join(", "), found.len(), errors.len());
        let message = if n as f64 > MAX_MISFIT_FRACTION * count as f64 {
            format!(
                "{n} of {count} photographs do not fit the others, too many to leave out; are their poses right? {names}"
            )
        } else {
            let mut trained = self.trained.clone();
            trained.retain(|view| found.iter().all(|(misfit, _)| misfit != view));
            self.train_on(trained);
            format!(
                "{n} of {count} photographs do not fit the others and are left out from here on (--set drop_misfits=false keeps them); are their poses right? {names}"
            )
        };
        Some(Event::Warned { message })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::{from_bytes, to_bytes};
    use crate::surroundings::tests::around;
    use crate::{Recipe, TrainOptions};
    use glam::Vec3;
    use irradia_scene::{Pose, Rng};
    use irradia_splat::{SplatState, Splats};
    use std::sync::Arc;

    #[test]
    fn wrong_photographs_are_found_and_odd_ones_are_not() {
        let mut rng = Rng::new(5, 1);
        let mut errors: Vec<(usize, f64)> = (0..50)
            .map(|i| (i, 0.05 * f64::from(0.15 * rng.normal()).exp()))
            .collect();
        assert_eq!(outliers(&errors), []);
        // A view with much detail.
        errors[9].1 = 0.09;
        assert_eq!(outliers(&errors), []);
        for view in [3, 17, 40] {
            errors[view].1 *= 4.0;
        }
        let mut found: Vec<usize> = outliers(&errors).iter().map(|(view, _)| *view).collect();
        found.sort_unstable();
        assert_eq!(found, [3, 17, 40]);
        // Photographs that all disagree have a wide spread.
        let wide: Vec<(usize, f64)> = (0..50).map(|i| (i, 0.05 * f64::from(rng.normal()).exp())).collect();
        assert_eq!(outliers(&wide), []);
        assert_eq!(outliers(&errors[..7]), []);
        // A person in front of the camera: the rest of the photograph is as good as the others.
        let mut both: Vec<(usize, [f64; 2])> = errors
            .iter()
            .map(|(view, error)| (*view, [*error, 0.5 * error]))
            .collect();
        both[17].1[1] /= 4.0;
        let mut found: Vec<usize> = misfits(&both).iter().map(|(view, _)| *view).collect();
        found.sort_unstable();
        assert_eq!(found, [3, 40]);
    }

    #[test]
    fn what_a_misfit_sees_does_not_count_any_more() {
        // Nine cameras on a circle, and one with a wrong pose. The first splat is opposite the first camera, where the wrong one sees it as
        // well; the second one is close before the wrong camera.
        let mut data = around(9);
        let (opposite, eye) = (Vec3::new(-1.0, 0.05, 0.02), Vec3::new(1.0, 0.0, 1.0));
        let mut wrong = data.views[0].clone();
        wrong.camera.pose = Pose::look_at(eye, opposite, Vec3::Y);
        data.views.push(wrong);
        data.train.push(9);
        (data.views.iter_mut()).for_each(|view| view.depth_bounds = Some([0.2, 9.0]));
        let data = Arc::new(data);
        let set = ["free_space=0.7".to_owned()];
        let recipe = Recipe::parse("classic", Recipe::built_in("classic").unwrap(), &set).unwrap();
        let options = TrainOptions::default();
        let mut trainer = Trainer::from_splats(data.clone(), recipe, options.clone(), Splats::zeros(4, 0)).unwrap();
        let cleared_and_moved = |trainer: &Trainer| {
            let mut splats = Splats::zeros(2, 0);
            let places = [opposite, eye.lerp(opposite, 0.05)];
            for (i, place) in places.into_iter().enumerate() {
                (0..3).for_each(|c| splats.means.set(c, i, place[c]));
            }
            let mut state = SplatState::new(splats);
            let cleared = trainer.free_space.clear(&mut state);
            [cleared, trainer.surroundings.as_ref().unwrap().move_away(&mut state)]
        };
        assert_eq!(cleared_and_moved(&trainer), [1, 0]);
        let errors: Vec<(usize, [f64; 2])> = (0..10).map(|i| (i, [if i == 9 { 0.5 } else { 0.05 }; 2])).collect();
        trainer.leave_out_misfits(&errors).expect("one is left out");
        assert_eq!(trainer.trained, (0..9).collect::<Vec<_>>());
        let resumed = from_bytes(&to_bytes(&trainer), data, options).unwrap();
        for trainer in [trainer, resumed] {
            assert_eq!(cleared_and_moved(&trainer), [0, 1]);
        }
    }
}
