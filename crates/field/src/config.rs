//! The configuration of a field.

use crate::FieldError;
use crate::background::{MAX_DEGREE, coefficient_count};
use crate::encoding::{DirectionEncoding, Frequency, HashGrid, PositionEncoding};
use crate::net::{Activation, ColorShape, Net, NetShape};
use crate::sample::march::Steps;
use serde::{Deserialize, Serialize};

/// How samples are placed along a ray.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Sampler {
    /// Steps through the occupied cells of a grid (Instant-NGP).
    Occupancy(Occupancy),
    /// NeRF: a coarse network over even intervals, and a fine one over these plus intervals drawn from the coarse weights.
    Hierarchy {
        /// Number of even intervals: 64.
        coarse: usize,
        /// Number of additional intervals for the fine network: 128.
        fine: usize,
    },
    /// mip-NeRF 360: small proposal networks place the samples of the last one.
    Proposal {
        /// Each proposal network with its number of intervals.
        rounds: Vec<(NetShape, usize)>,
        /// Number of intervals of the last network.
        last: usize,
    },
    /// No ray sampling: the field adds to the colours of given points, such as splats ([`crate::residual_at`]).
    Given {
        /// Directions are view directions reflected at the point's surface, instead of view directions.
        mirrored: bool,
    },
}

/// Options of the occupancy grid.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Occupancy {
    /// Cells per side; 128 in Instant-NGP.
    pub side: usize,
    /// Step lengths.
    pub steps: Steps,
    /// A cell is occupied if a step in it has at least this optical depth; 0.01 in Instant-NGP.
    pub thickness: f32,
    /// Decay of a cell's density at each update; 0.95 in Instant-NGP.
    pub decay: f32,
}

/// Everything that determines the shape of a field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldConfig {
    /// The network that outputs colour (both of them, for a hierarchy).
    pub net: NetShape,
    /// How samples are placed.
    pub sampler: Sampler,
    /// Number of photographs with an appearance code, if [`ColorShape::appearance`] is not 0.
    pub images: usize,
    /// Degree of the spherical harmonics, 0 to 3, of a background learnt with the field; `None` if the background is given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub background_degree: Option<u32>,
}

/// Maximum number of samples per ray and round.
const MAX_SAMPLES: usize = 1 << 16;

impl FieldConfig {
    /// Instant-NGP at sizes suited to CPUs: 8 levels of 4 features in tables of 2^15 corners, hidden layers of 32.
    pub fn hash_grid() -> Self {
        Self {
            net: NetShape {
                encoding: PositionEncoding::HashGrid(HashGrid {
                    levels: 8,
                    features: 4,
                    log2_table: 15,
                    coarsest: 16,
                    finest: 512,
                }),
                width: 32,
                depth: 1,
                skip: None,
                geometry: 15,
                activation: Activation::Exp,
                density_bias: -1.0,
                color: Some(ColorShape {
                    direction: DirectionEncoding::Harmonics,
                    width: 32,
                    depth: 2,
                    appearance: 0,
                }),
            },
            sampler: Sampler::Occupancy(Occupancy {
                side: 128,
                steps: Steps {
                    shortest: 2.0 * 3.0f32.sqrt() / 512.0,
                    cone: 0.0,
                },
                thickness: 0.01,
                decay: 0.8,
            }),
            images: 0,
            background_degree: None,
        }
    }

    /// NeRF: `width` is 256 as published, and half of that in the colour head.
    pub fn nerf(width: usize, coarse: usize, fine: usize) -> Self {
        Self {
            net: NetShape {
                encoding: PositionEncoding::Frequency(Frequency { octaves: 10 }),
                width,
                depth: 8,
                skip: Some(5),
                geometry: width,
                activation: Activation::Relu,
                density_bias: 0.0,
                color: Some(ColorShape {
                    direction: DirectionEncoding::Frequency(Frequency { octaves: 4 }),
                    width: width / 2,
                    depth: 1,
                    appearance: 0,
                }),
            },
            sampler: Sampler::Hierarchy { coarse, fine },
            images: 0,
            background_degree: None,
        }
    }

    /// A field that adds to the colours of given points.
    pub fn residual(net: NetShape, mirrored: bool, images: usize) -> Self {
        Self {
            net,
            sampler: Sampler::Given { mirrored },
            images,
            background_degree: None,
        }
    }

    /// Length of an appearance code.
    pub fn appearance(&self) -> usize {
        self.net.color.map_or(0, |color| color.appearance)
    }

    /// The shapes of all networks, in order of evaluation.
    pub fn nets(&self) -> Vec<NetShape> {
        match &self.sampler {
            Sampler::Occupancy(_) | Sampler::Given { .. } => vec![self.net],
            Sampler::Hierarchy { .. } => vec![self.net; 2],
            Sampler::Proposal { rounds, .. } => rounds.iter().map(|(net, _)| *net).chain([self.net]).collect(),
        }
    }

    /// Number of values in [`crate::Field::tensors`]: the trained parameters and the occupancy grid.
    pub fn value_count(&self) -> usize {
        let nets = self.nets().into_iter().map(|shape| Net::new(shape).sizes());
        let grid = match &self.sampler {
            Sampler::Occupancy(o) => o.side.pow(3),
            _ => 0,
        };
        nets.flatten().sum::<usize>()
            + self.images * self.appearance()
            + coefficient_count(self.background_degree)
            + grid
    }

    /// Checks that all sizes are within bounds.
    ///
    /// # Errors
    /// The first size that is out of bounds.
    pub fn check(&self) -> Result<(), FieldError> {
        let wrong = |what, value: String, hint| Err(FieldError::Config { what, value, hint });
        if let Some(degree) = self.background_degree.filter(|degree| *degree > MAX_DEGREE) {
            return wrong("degree of the background", degree.to_string(), "must be 0 to 3");
        }
        // A file beyond these limits is broken, and sums of its sizes could overflow.
        let limits = |net: &NetShape| {
            let octaves = match net.encoding {
                PositionEncoding::Frequency(f) => f.octaves,
                PositionEncoding::HashGrid(_) => 0,
            };
            let toward = match net.color.map(|color| color.direction) {
                Some(DirectionEncoding::Frequency(f)) => f.octaves,
                _ => 0,
            };
            let color = net.color.map_or([0; 3], |c| [c.width, c.depth, c.appearance]);
            [
                ("width of a hidden layer", net.width, 4096, "must be at most 4096"),
                ("number of hidden layers", net.depth, 64, "must be at most 64"),
                ("geometry", net.geometry, 4096, "must be at most 4096"),
                ("octaves", octaves.max(toward), 32, "must be at most 32"),
                ("width of a colour layer", color[0], 4096, "must be at most 4096"),
                ("number of colour layers", color[1], 64, "must be at most 64"),
                ("appearance code", color[2], 4096, "must be at most 4096"),
            ]
        };
        if self.images > 1 << 24 {
            return wrong("number of images", self.images.to_string(), "must be at most 2^24");
        }
        for net in self.nets() {
            for (what, value, limit, hint) in limits(&net) {
                if value > limit {
                    return wrong(what, value.to_string(), hint);
                }
            }
            if let PositionEncoding::HashGrid(g) = &net.encoding {
                if ![1, 2, 4, 8].contains(&g.features) {
                    return wrong("features of a level", g.features.to_string(), "must be 1, 2, 4 or 8");
                }
                if !(1..=32).contains(&g.levels) {
                    return wrong("levels", g.levels.to_string(), "must be 1 to 32");
                }
                if !(4..=24).contains(&g.log2_table) {
                    return wrong("log2 of a table", g.log2_table.to_string(), "must be 4 to 24");
                }
                if g.coarsest < 1 || g.finest < g.coarsest || g.finest > 1 << 20 {
                    let range = format!("{}..{}", g.coarsest, g.finest);
                    return wrong("resolution of the grid", range, "must be ascending, from 1 to 2^20");
                }
            }
            if net.width == 0 || !net.width.is_multiple_of(8) {
                return wrong(
                    "width of a hidden layer",
                    net.width.to_string(),
                    "must be a multiple of 8",
                );
            }
            if let Some(skip) = net.skip.filter(|skip| !(1..net.depth).contains(skip)) {
                return wrong(
                    "layer with a skip connection",
                    skip.to_string(),
                    "must be a hidden layer after the first",
                );
            }
            if let Some(color) = net.color {
                if color.width == 0 || !color.width.is_multiple_of(8) {
                    return wrong(
                        "width of a colour layer",
                        color.width.to_string(),
                        "must be a multiple of 8",
                    );
                }
                if color.appearance != self.appearance() {
                    let value = color.appearance.to_string();
                    return wrong(
                        "appearance code",
                        value,
                        "must be the same for all networks that output colour",
                    );
                }
                if color.appearance > 0 && self.images == 0 {
                    return wrong("number of images", "0".into(), "appearance codes need one per image");
                }
            }
        }
        if self.net.color.is_none() {
            return wrong("colour part", "absent".into(), "the last network must output colour");
        }
        match &self.sampler {
            Sampler::Occupancy(o) => {
                if !(4..=512).contains(&o.side) {
                    return wrong("side of the occupancy grid", o.side.to_string(), "must be 4 to 512");
                }
                if !(o.steps.shortest > 1e-5 && o.steps.cone >= 0.0 && o.steps.cone < 1.0) {
                    return wrong(
                        "step",
                        o.steps.shortest.to_string(),
                        "must be more than 1e-5, with a cone of 0 to 1",
                    );
                }
                if !(0.0..).contains(&o.thickness) {
                    return wrong("thickness", o.thickness.to_string(), "must be 0 or more");
                }
                if !(o.decay > 0.0 && o.decay <= 1.0) {
                    return wrong("decay", o.decay.to_string(), "must be more than 0 and at most 1");
                }
            }
            Sampler::Hierarchy { coarse, fine } => {
                if !(2..=MAX_SAMPLES).contains(coarse) || !(1..=MAX_SAMPLES).contains(fine) {
                    let value = format!("{coarse} + {fine}");
                    return wrong("samples", value, "must be at least 2 and 1, and at most 65536");
                }
            }
            Sampler::Proposal { rounds, last } => {
                let mut counts = rounds.iter().map(|(_, n)| n).chain([last]);
                if rounds.is_empty() || counts.any(|n| !(2..=MAX_SAMPLES).contains(n)) {
                    return wrong(
                        "samples of a round",
                        last.to_string(),
                        "needs at least one round, and 2 to 65536 samples in each",
                    );
                }
            }
            Sampler::Given { .. } => {}
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The message for [`FieldConfig::nerf`] with `skip`.
    fn with_skip(skip: usize) -> Option<String> {
        let mut config = FieldConfig::nerf(64, 64, 128);
        config.net.skip = Some(skip);
        config.check().err().map(|error| error.to_string())
    }

    /// The message for [`FieldConfig::hash_grid`] with the grid's `thickness` and `decay`.
    fn with_grid(thickness: f32, decay: f32) -> Option<String> {
        let mut config = FieldConfig::hash_grid();
        if let Sampler::Occupancy(grid) = &mut config.sampler {
            (grid.thickness, grid.decay) = (thickness, decay);
        }
        config.check().err().map(|error| error.to_string())
    }

    #[test]
    fn values_without_meaning_are_refused_by_name() {
        assert_eq!([with_skip(1), with_skip(7)], [None, None]);
        for skip in [0, 8] {
            assert!(with_skip(skip).is_some_and(|line| line.contains("skip")), "{skip}");
        }
        assert_eq!([with_grid(0.0, 1.0), with_grid(0.01, 0.8)], [None, None]);
        for thickness in [-0.01, f32::NAN] {
            assert!(with_grid(thickness, 0.8).is_some_and(|line| line.contains("thickness")));
        }
        for decay in [0.0, -0.5, 1.5, f32::NAN] {
            assert!(with_grid(0.01, decay).is_some_and(|line| line.contains("decay")));
        }
    }
}
