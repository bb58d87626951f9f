//! The protocols of published benchmarks: size of the images, split and background, as in the papers.

use crate::{Background, Reading};
use irradia_scene::Dataset;
use std::fmt;
use std::str::FromStr;

/// A benchmark's protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Protocol {
    /// The synthetic scenes of NeRF: 800 x 800, their own test views, over white.
    Blender,
    /// The forward-facing scenes of LLFF: a quarter of the size (1008 x 756), every 8th view held out.
    Llff,
    /// mip-NeRF 360: half the size indoors, a quarter outdoors, every 8th view held out.
    MipNerf360,
    /// Truck and Train of Tanks and Temples as 3DGS provides them: 980 pixels wide, every 8th view held out.
    TandT,
}

/// The indoor scenes of mip-NeRF 360.
const INDOOR_SCENES: [&str; 4] = ["room", "counter", "kitchen", "bonsai"];

impl Protocol {
    /// All protocols.
    pub const ALL: [Protocol; 4] = [Protocol::Blender, Protocol::Llff, Protocol::MipNerf360, Protocol::TandT];

    /// `blender`, `llff`, `mipnerf360` or `tandt`.
    pub fn name(self) -> &'static str {
        match self {
            Protocol::Blender => "blender",
            Protocol::Llff => "llff",
            Protocol::MipNerf360 => "mipnerf360",
            Protocol::TandT => "tandt",
        }
    }

    /// How the scene `scene` is read.
    pub fn reading(self, scene: &str) -> Reading {
        let every_8th = Some("8".to_owned());
        let (downscale, holdout) = match self {
            Protocol::Blender => (1.0, None),
            Protocol::Llff => (4.0, every_8th),
            Protocol::MipNerf360 if INDOOR_SCENES.contains(&scene) => (2.0, every_8th),
            Protocol::MipNerf360 => (4.0, every_8th),
            Protocol::TandT => (1.0, every_8th),
        };
        Reading {
            downscale,
            max_side: None,
            holdout,
            ..Reading::default()
        }
    }

    /// The background of photographs with alpha, in training and evaluation.
    pub fn background(self) -> Option<Background> {
        (self == Protocol::Blender).then_some(Background::White)
    }

    /// Range of the longer side of the images on which the published figures are measured, pixels.
    fn longer_side(self, scene: &str) -> [u32; 2] {
        match self {
            Protocol::Blender => [800, 800],
            Protocol::Llff => [1008, 1008],
            Protocol::MipNerf360 if INDOOR_SCENES.contains(&scene) => [1556, 1560],
            Protocol::MipNerf360 => [1236, 1298],
            Protocol::TandT => [976, 984],
        }
    }

    /// The differences between `dataset`, read by [`Self::reading`], and the benchmark's scene `scene` that make figures incomparable, a
    /// line each.
    pub fn differences(self, scene: &str, dataset: &Dataset) -> Vec<String> {
        let mut differences = Vec::new();
        let views = dataset.test.iter().map(|i| &dataset.views[*i].camera.intrinsics);
        let sides = views.map(|k| k.width.max(k.height));
        let [low, high] = self.longer_side(scene);
        if let Some(side) = sides.into_iter().find(|side| !(low..=high).contains(side)) {
            let expected = if low == high {
                low.to_string()
            } else {
                format!("{low} to {high}")
            };
            differences.push(format!(
                "the images are {side} pixels on the longer side instead of {expected}"
            ));
        }
        let counts = (dataset.train.len(), dataset.test.len());
        if self == Protocol::Blender && counts != (100, 200) {
            let (train, test) = counts;
            differences.push(format!(
                "{train} views to train on and {test} held out instead of 100 and 200"
            ));
        }
        differences
    }
}

impl fmt::Display for Protocol {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Protocol {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let known = Self::ALL.into_iter().find(|protocol| protocol.name() == text);
        known.ok_or_else(|| "use blender, llff, mipnerf360 or tandt".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_synth::{SynthOptions, dataset};

    #[test]
    fn sizes_and_splits_are_those_of_the_papers() {
        let downscale = |protocol: Protocol, scene: &str| protocol.reading(scene).downscale;
        assert_eq!(downscale(Protocol::MipNerf360, "kitchen"), 2.0);
        assert_eq!(downscale(Protocol::MipNerf360, "garden"), 4.0);
        assert_eq!(downscale(Protocol::Llff, "fern"), 4.0);
        for protocol in Protocol::ALL {
            assert_eq!(protocol.name().parse(), Ok(protocol));
            let reading = protocol.reading("x");
            assert!(reading.check().is_ok() && reading.max_side.is_none());
            assert_eq!(reading.holdout.is_none(), protocol == Protocol::Blender);
        }
        assert_eq!(Protocol::Blender.background(), Some(Background::White));
        assert!("nerf".parse::<Protocol>().is_err());
    }

    #[test]
    fn other_sizes_and_splits_are_told() {
        let options = SynthOptions {
            views: 4,
            width: 24,
            height: 16,
            ..SynthOptions::default()
        };
        let differences = Protocol::Blender.differences("chair", &dataset(&options).expect("options"));
        assert_eq!(
            differences,
            [
                "the images are 24 pixels on the longer side instead of 800",
                "4 views to train on and 2 held out instead of 100 and 200"
            ]
        );
    }
}
