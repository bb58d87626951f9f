//! How a stage adds, removes and merges splats: the parameters of each strategy, with sizes in units of the scene's extent.

use super::check::{Checked, at_least_one, check, not_negative, opacity, reset_to};
use super::keys::documented;
use irradia_splat::Statistics;
use irradia_splat::densify::classic::ClassicOptions;
use irradia_splat::densify::fast::FastOptions;
use irradia_splat::densify::mcmc::McmcOptions;
use irradia_splat::densify::merge::MergeOptions;
use irradia_splat::densify::taming::{ScoreWeights, TamingOptions};
use serde::{Deserialize, Serialize};

/// The settings that 3DGS and Taming 3DGS share.
fn by_gradient(gradient_threshold: f32, small: f32, max_scale: f32, opacity: f32) -> [Checked; 4] {
    [
        not_negative("gradient_threshold", gradient_threshold),
        not_negative("small", small),
        not_negative("max_scale", max_scale),
        reset_to(opacity),
    ]
}

/// A strategy.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "strategy", rename_all = "snake_case")]
pub enum DensityControl {
    /// Clone, split, prune and reset, as in 3DGS; also AbsGS's variant of it.
    Classic(ClassicSettings),
    /// Relocation and growth by opacity, as in 3DGS-MCMC.
    Mcmc(McmcSettings),
    /// Growth to an exact number by score, as in Taming 3DGS.
    Taming(TamingSettings),
    /// Splits by image error, to a planned number.
    Fast(FastSettings),
}

impl DensityControl {
    /// Steps (of the run, not stretched) between rounds.
    pub fn every(&self) -> u64 {
        match self {
            DensityControl::Classic(settings) => settings.every,
            DensityControl::Mcmc(settings) => settings.every,
            DensityControl::Taming(settings) => settings.every,
            DensityControl::Fast(settings) => settings.every,
        }
    }

    /// Checks that every number is in range.
    pub(super) fn validate(&self) -> Result<(), String> {
        let min_opacity = match self {
            DensityControl::Classic(settings) => settings.min_opacity,
            DensityControl::Mcmc(settings) => settings.min_opacity,
            DensityControl::Taming(settings) => settings.min_opacity,
            DensityControl::Fast(settings) => settings.min_opacity,
        };
        check(&[at_least_one("every", self.every()), opacity("min_opacity", min_opacity)])?;
        match self {
            DensityControl::Classic(settings) => check(&by_gradient(
                settings.gradient_threshold,
                settings.small,
                settings.max_scale,
                settings.reset_to,
            )),
            DensityControl::Mcmc(settings) => {
                check(&[("growth", settings.growth, settings.growth >= 1.0, "1 or more")])
            }
            DensityControl::Taming(settings) => {
                check(&by_gradient(
                    settings.gradient_threshold,
                    settings.small,
                    settings.max_scale,
                    settings.reset_to,
                ))?;
                let edges = settings.edge_share;
                check(&[
                    ("edge_share", edges, (0.0..=1.0).contains(&edges), "0 to 1"),
                    not_negative("score_gradient", settings.score_gradient),
                    not_negative("score_error", settings.score_error),
                    not_negative("score_weight", settings.score_weight),
                    not_negative("score_opacity", settings.score_opacity),
                    not_negative("score_extent", settings.score_extent),
                    not_negative("score_volume", settings.score_volume),
                ])
            }
            DensityControl::Fast(settings) => check(&[
                not_negative("min_weight", settings.min_weight),
                not_negative("error_threshold", settings.error_threshold),
                not_negative("min_extent", settings.min_extent),
                not_negative("floor", settings.floor),
            ]),
        }
    }

    /// Steps (of the run, not stretched) between resets of the opacities and the value to which they are reset.
    pub fn reset(&self) -> Option<(u64, f32)> {
        match self {
            DensityControl::Classic(settings) => {
                (settings.reset_every > 0).then_some((settings.reset_every, settings.reset_to))
            }
            DensityControl::Taming(settings) => {
                (settings.reset_every > 0).then_some((settings.reset_every, settings.reset_to))
            }
            DensityControl::Mcmc(_) | DensityControl::Fast(_) => None,
        }
    }

    /// Whether its statistics are gathered in the stage before as well, like those of the 3DGS code, which begin with the run and not with
    /// `densify_from_iter`.
    pub fn gathers_early(&self) -> bool {
        match self {
            DensityControl::Classic(_) | DensityControl::Taming(_) => true,
            DensityControl::Mcmc(_) | DensityControl::Fast(_) => false,
        }
    }

    /// Fraction of the cap available to a run with `pace` recipe steps per step.
    pub fn limit_fraction(&self, pace: f64) -> f64 {
        match self {
            DensityControl::Fast(_) => pace.max(1.0).powf(-0.5),
            DensityControl::Classic(_) | DensityControl::Mcmc(_) | DensityControl::Taming(_) => 1.0,
        }
    }

    /// Weight of the photograph's edges in the gathered error.
    pub fn edge_share(&self) -> f32 {
        match self {
            DensityControl::Taming(settings) => settings.edge_share,
            DensityControl::Classic(_) | DensityControl::Mcmc(_) | DensityControl::Fast(_) => 0.0,
        }
    }

    /// The statistics that it needs.
    pub fn statistics(&self) -> Statistics {
        match self {
            DensityControl::Classic(settings) if settings.absolute => Statistics::AbsoluteGradient,
            DensityControl::Classic(_) | DensityControl::Mcmc(_) => Statistics::Gradient,
            DensityControl::Taming(_) | DensityControl::Fast(_) => Statistics::Error,
        }
    }
}

documented! {
    /// Parameters of [`irradia_splat::densify::classic`].
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct ClassicSettings {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Mean screen gradient, normalised device coordinates, from which a splat is densified.
        pub gradient_threshold: f32,
        /// Whether the gradients of a splat's fragments are summed as absolute values (AbsGS).
        #[serde(default)]
        pub absolute: bool,
        /// Whether both splats of a clone get a reduced opacity.
        #[serde(default)]
        pub revised_opacity: bool,
        /// Size that separates splats to clone from splats to split, in units of the scene's extent.
        pub small: f32,
        /// Opacity below which a splat is removed.
        pub min_opacity: f32,
        /// World size above which a splat is removed, in units of the scene's extent, once opacities have been reset.
        pub max_scale: f32,
        /// Steps (of the run, not stretched) between resets of the opacities; 0 for never.
        pub reset_every: u64,
        /// Maximum opacity after a reset.
        pub reset_to: f32,
    }
}

impl ClassicSettings {
    /// Options with sizes in world units.
    pub fn options(&self, extent: f32, prune_large: bool, max_splats: usize) -> ClassicOptions {
        ClassicOptions {
            gradient_threshold: self.gradient_threshold,
            small: self.small * extent,
            min_opacity: self.min_opacity,
            max_scale: prune_large.then_some(self.max_scale * extent),
            max_splats,
            revised_opacity: self.revised_opacity,
        }
    }
}

documented! {
    /// Parameters of [`irradia_splat::densify::mcmc`].
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct McmcSettings {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Growth factor of the number of splats in `every` recipe steps.
        pub growth: f32,
        /// Opacity up to which a splat is dead.
        pub min_opacity: f32,
    }
}

impl McmcSettings {
    /// Options for a run with `pace` recipe steps per step.
    pub fn options(&self, pace: f64, max_splats: usize) -> McmcOptions {
        McmcOptions {
            min_opacity: self.min_opacity,
            growth: f64::from(self.growth).powf(pace) as f32,
            max_splats,
        }
    }
}

documented! {
    /// Parameters of [`irradia_splat::densify::taming`].
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct TamingSettings {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Mean screen gradient, normalised device coordinates, from which a splat may be densified.
        pub gradient_threshold: f32,
        /// Size that separates splats to clone from splats to split, in units of the scene's extent.
        pub small: f32,
        /// Opacity below which a splat may be removed.
        pub min_opacity: f32,
        /// World size above which a splat may be removed, in units of the scene's extent, once opacities have been reset.
        pub max_scale: f32,
        /// Number of rounds, from the stage's first, that remove splats.
        pub prune_rounds: u64,
        /// Steps (of the run, not stretched) between resets of the opacities; 0 for never.
        pub reset_every: u64,
        /// Maximum opacity after a reset.
        pub reset_to: f32,
        /// Weight of the photograph's edges in the error of a pixel for the score, 0 to 1; the rest is the absolute difference.
        pub edge_share: f32,
        /// Weight of the mean screen gradient in the score.
        pub score_gradient: f32,
        /// Weight of the mean error in the score.
        pub score_error: f32,
        /// Weight of the mean blending weight in the score.
        pub score_weight: f32,
        /// Weight of the opacity in the score.
        pub score_opacity: f32,
        /// Weight of the half size on screen in the score.
        pub score_extent: f32,
        /// Weight of the volume in the score.
        pub score_volume: f32,
    }
}

impl TamingSettings {
    /// Options with sizes in world units, for round `round` of the stage, from 1.
    pub fn options(&self, extent: f32, prune_large: bool, round: u64, target: usize) -> TamingOptions {
        TamingOptions {
            target,
            gradient_threshold: self.gradient_threshold,
            small: self.small * extent,
            min_opacity: self.min_opacity,
            max_scale: prune_large.then_some(self.max_scale * extent),
            prunes: round <= self.prune_rounds,
            weights: ScoreWeights {
                gradient: self.score_gradient,
                error: self.score_error,
                weight: self.score_weight,
                opacity: self.score_opacity,
                extent: self.score_extent,
                volume: self.score_volume,
            },
        }
    }
}

documented! {
    /// Parameters of [`irradia_splat::densify::fast`], for a run of as many steps as the recipe has. A run of a quarter of them can
    /// train fewer splats: it may use half the cap, and splits from four times the error.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct FastSettings {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Opacity below which a splat is removed.
        pub min_opacity: f32,
        /// Mean weight per frame, in pixels, below which a splat is removed. It must have been in view of at least two frames and as many as
        /// a fifth of the training views: in a house, splats are in most views behind walls, and shown by few.
        pub min_weight: f32,
        /// Mean error per frame, mean absolute colour difference times pixels, from which a splat is split.
        pub error_threshold: f32,
        /// Half size on screen, pixels, from which a splat is worth splitting.
        pub min_extent: f32,
        /// Number of splats per pixel of a training image below which none are removed; at most the number of first splats.
        #[serde(default)]
        pub floor: f32,
    }
}

impl FastSettings {
    /// Options for at least `floor` and at most `target` splats after the round, in a run on `views` training views with `pace` recipe steps
    /// per step.
    pub fn options(&self, pace: f64, views: usize, floor: usize, target: usize) -> FastOptions {
        FastOptions {
            target,
            floor,
            min_opacity: self.min_opacity,
            min_weight: self.min_weight,
            min_frames: (views as f32 / 5.0).max(2.0),
            error_threshold: self.error_threshold * pace as f32,
            min_extent: self.min_extent,
        }
    }
}

documented! {
    /// Parameters of merging in a stage ([`irradia_splat::densify::merge`]).
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct MergeSettings {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Maximum distance of splats to merge, in units of the smaller one's median axis.
        pub distance: f32,
        /// Maximum difference of splats to merge, in any channel of the base colour.
        pub color: f32,
    }
}

impl MergeSettings {
    /// Checks that every number is in range.
    pub(super) fn validate(&self) -> Result<(), String> {
        check(&[
            at_least_one("every", self.every),
            not_negative("distance", self.distance),
            not_negative("color", self.color),
        ])
    }

    /// The strategy's options.
    pub fn options(&self) -> MergeOptions {
        MergeOptions {
            distance: self.distance,
            color: self.color,
        }
    }
}
