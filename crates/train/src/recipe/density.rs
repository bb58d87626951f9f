//! How a stage adds, removes and merges splats: the knobs of each strategy, with sizes in units of the scene's extent.

use super::keys::documented;
use irradia_splat::Statistics;
use irradia_splat::densify::classic::ClassicOptions;
use irradia_splat::densify::fast::FastOptions;
use irradia_splat::densify::mcmc::McmcOptions;
use irradia_splat::densify::merge::MergeOptions;
use irradia_splat::densify::taming::{ScoreWeights, TamingOptions};
use serde::{Deserialize, Serialize};

/// A strategy.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "strategy", rename_all = "snake_case")]
pub enum Density {
    /// Clone, split, prune and reset, as in 3DGS; also AbsGS's variant of it.
    Classic(ClassicKnobs),
    /// Relocation and growth by opacity, as in 3DGS-MCMC.
    Mcmc(McmcKnobs),
    /// Growth to an exact number by score, as in Taming 3DGS.
    Taming(TamingKnobs),
    /// Splits where the pictures are wrong, to a planned number.
    Fast(FastKnobs),
}

impl Density {
    /// Steps (of the run, not stretched) between rounds.
    pub fn every(&self) -> u64 {
        match self {
            Density::Classic(knobs) => knobs.every,
            Density::Mcmc(knobs) => knobs.every,
            Density::Taming(knobs) => knobs.every,
            Density::Fast(knobs) => knobs.every,
        }
    }

    /// Steps (of the run, not stretched) between resets of the opacities and what they are lowered to.
    pub fn reset(&self) -> Option<(u64, f32)> {
        match self {
            Density::Classic(knobs) => (knobs.reset_every > 0).then_some((knobs.reset_every, knobs.reset_to)),
            Density::Taming(knobs) => (knobs.reset_every > 0).then_some((knobs.reset_every, knobs.reset_to)),
            Density::Mcmc(_) | Density::Fast(_) => None,
        }
    }

    /// Whether its statistics begin in the stage before, as those of the 3DGS code begin with the run and not with
    /// `densify_from_iter`.
    pub fn gathers_ahead(&self) -> bool {
        match self {
            Density::Classic(_) | Density::Taming(_) => true,
            Density::Mcmc(_) | Density::Fast(_) => false,
        }
    }

    /// Share of the cap that a run may fill in which `pace` recipe steps go by in one step.
    pub fn limit_share(&self, pace: f64) -> f64 {
        match self {
            Density::Fast(_) => pace.max(1.0).powf(-0.5),
            Density::Classic(_) | Density::Mcmc(_) | Density::Taming(_) => 1.0,
        }
    }

    /// Share of the photograph's edges in the error that is gathered for it.
    pub fn edge_share(&self) -> f32 {
        match self {
            Density::Taming(knobs) => knobs.edge_share,
            Density::Classic(_) | Density::Mcmc(_) | Density::Fast(_) => 0.0,
        }
    }

    /// What has to be gathered for it.
    pub fn statistics(&self) -> Statistics {
        match self {
            Density::Classic(knobs) if knobs.absolute => Statistics::AbsoluteGradient,
            Density::Classic(_) | Density::Mcmc(_) => Statistics::Gradient,
            Density::Taming(_) | Density::Fast(_) => Statistics::Error,
        }
    }
}

documented! {
    /// Knobs of [`irradia_splat::densify::classic`].
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct ClassicKnobs {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Mean screen gradient, normalised device coordinates, from which a splat is densified.
        pub gradient_threshold: f32,
        /// Whether the gradients of a splat's fragments are added absolutely (AbsGS).
        #[serde(default)]
        pub absolute: bool,
        /// Whether clones share the opacity of what they copy.
        #[serde(default)]
        pub revised_opacity: bool,
        /// Size that divides what is cloned from what is split, in units of the scene's extent.
        pub small: f32,
        /// Opacity below which a splat is removed.
        pub min_opacity: f32,
        /// World size above which a splat is removed, in units of the scene's extent, once opacities were reset.
        pub max_scale: f32,
        /// Steps (of the run, not stretched) between resets of the opacities; 0 for never.
        pub reset_every: u64,
        /// Opacity that a reset leaves at most.
        pub reset_to: f32,
    }
}

impl ClassicKnobs {
    /// With sizes in world units.
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
    /// Knobs of [`irradia_splat::densify::mcmc`].
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct McmcKnobs {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Factor on the number of splats in `every` recipe steps.
        pub growth: f32,
        /// Opacity from which down a splat is dead.
        pub min_opacity: f32,
    }
}

impl McmcKnobs {
    /// For a run in which `pace` recipe steps go by in one step.
    pub fn options(&self, pace: f64, max_splats: usize) -> McmcOptions {
        McmcOptions {
            min_opacity: self.min_opacity,
            growth: f64::from(self.growth).powf(pace) as f32,
            max_splats,
        }
    }
}

documented! {
    /// Knobs of [`irradia_splat::densify::taming`].
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct TamingKnobs {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Mean screen gradient, normalised device coordinates, from which a splat may be densified.
        pub gradient_threshold: f32,
        /// Size that divides what is cloned from what is split, in units of the scene's extent.
        pub small: f32,
        /// Opacity below which a splat may be removed.
        pub min_opacity: f32,
        /// World size above which a splat may be removed, in units of the scene's extent, once opacities were reset.
        pub max_scale: f32,
        /// Rounds, from the stage's first, that remove splats.
        pub prune_rounds: u64,
        /// Steps (of the run, not stretched) between resets of the opacities; 0 for never.
        pub reset_every: u64,
        /// Opacity that a reset leaves at most.
        pub reset_to: f32,
        /// Share of the photograph's edges in the error that pixels give to the score, 0 to 1; the rest is the absolute difference.
        pub edge_share: f32,
        /// Weight of the mean screen gradient in the score.
        pub score_gradient: f32,
        /// Weight of the mean error shown in the score.
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

impl TamingKnobs {
    /// With sizes in world units, for round number `round` of the stage, from 1.
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
    /// Knobs of [`irradia_splat::densify::fast`], for a run of as many steps as the recipe has. A run of a quarter of them has
    /// less to give to each splat: it may fill half the cap, and what it cuts shows four times the error.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct FastKnobs {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Opacity below which a splat is removed.
        pub min_opacity: f32,
        /// Mean weight a frame, in pixels, below which a splat is removed.
        pub min_weight: f32,
        /// Mean error a frame, mean absolute colour difference times pixels, from which a splat is cut in two.
        pub error_threshold: f32,
        /// Half size on screen in pixels from which a splat is worth cutting.
        pub min_extent: f32,
    }
}

impl FastKnobs {
    /// For at most `target` splats after the round, in a run in which `pace` recipe steps go by in one step.
    pub fn options(&self, pace: f64, target: usize) -> FastOptions {
        FastOptions {
            target,
            min_opacity: self.min_opacity,
            min_weight: self.min_weight,
            error_threshold: self.error_threshold * pace as f32,
            min_extent: self.min_extent,
        }
    }
}

documented! {
    /// When and what a stage merges ([`irradia_splat::densify::merge`]).
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct MergeKnobs {
        /// Steps (of the run, not stretched) between rounds, at least 1.
        pub every: u64,
        /// Largest distance of splats that are merged, in units of the smaller one's median axis.
        pub distance: f32,
        /// Largest difference of splats that are merged, in any channel of the base colour.
        pub color: f32,
    }
}

impl MergeKnobs {
    /// As the strategy takes it.
    pub fn options(&self) -> MergeOptions {
        MergeOptions {
            distance: self.distance,
            color: self.color,
        }
    }
}
