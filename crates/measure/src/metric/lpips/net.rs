//! The networks whose features LPIPS compares.

use std::fmt;
use std::str::FromStr;

/// A backbone of LPIPS v0.1. Published tables mostly use AlexNet or VGG; distances of different networks are not comparable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LpipsNet {
    /// SqueezeNet 1.1 (Iandola et al. 2016): the smallest and fastest.
    Squeeze,
    /// AlexNet (Krizhevsky 2014): what the authors recommend for evaluation.
    Alex,
    /// VGG16 (Simonyan and Zisserman 2015): what most papers on view synthesis report.
    Vgg,
}

impl LpipsNet {
    /// All networks, in the order in which a folder is searched.
    pub const ALL: [Self; 3] = [Self::Squeeze, Self::Alex, Self::Vgg];

    /// `squeeze`, `alex` or `vgg`, as the authors name them.
    pub fn name(self) -> &'static str {
        match self {
            Self::Squeeze => "squeeze",
            Self::Alex => "alex",
            Self::Vgg => "vgg",
        }
    }

    /// File name of its weights.
    pub fn file_name(self) -> &'static str {
        match self {
            Self::Squeeze => "lpips_squeeze.safetensors",
            Self::Alex => "lpips_alex.safetensors",
            Self::Vgg => "lpips_vgg.safetensors",
        }
    }

    /// The smallest image side, pixels, that its strides and poolings do not reduce to nothing.
    pub fn min_side(self) -> u32 {
        match self {
            Self::Squeeze => 17,
            Self::Alex => 31,
            Self::Vgg => 16,
        }
    }

    /// Name of a tensor that no other backbone has.
    fn unique_tensor(self) -> &'static str {
        match self {
            Self::Squeeze => "features.3.squeeze.weight",
            Self::Alex => "features.3.weight",
            Self::Vgg => "features.28.weight",
        }
    }

    /// The network whose tensors are present according to `has`.
    pub(super) fn recognise(has: impl Fn(&str) -> bool) -> Option<Self> {
        Self::ALL.into_iter().find(|net| has(net.unique_tensor()))
    }
}

impl fmt::Display for LpipsNet {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for LpipsNet {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let known = Self::ALL.into_iter().find(|net| net.name() == text);
        known.ok_or_else(|| "use squeeze, alex or vgg".to_owned())
    }
}
