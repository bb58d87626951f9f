//! The table of parameters: every value that a recipe can change over time, one row each.
//!
//! A row is the only definition of a parameter. The names in recipes, bounds and their errors, `irradia recipe keys`,
//! `docs/recipe-keys.md`, the losses listed by `ingredients` and `recipe show`, the curves of a report and the values in a
//! checkpoint are generated from it. Recipes are written in the order of the rows.

use std::ops::RangeInclusive;

/// The purpose of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// Amount of data and number of splats in use: the parameters of `ingredients.data_schedule`.
    Data,
    /// Constraints on splats.
    Splats,
    /// Weight of a loss.
    Loss,
    /// Detail of the loss whose weight is named.
    PartOf(Param),
    /// Weight of a regulariser.
    Regularizer,
    /// Learning rate of splats.
    Rate,
    /// Rates and weights of a radiance field.
    Field,
    /// Rates and weights of occupants of a step's sockets.
    Socket,
    /// On from 0.5 up, off below.
    Switch,
}

/// One parameter.
#[derive(Debug)]
pub struct Row {
    /// Its name in recipes.
    pub name: &'static str,
    /// Unit of its value; empty if dimensionless.
    pub unit: &'static str,
    /// Value if no recipe sets it.
    pub default: f64,
    /// Allowed values.
    pub bounds: RangeInclusive<f64>,
    /// Its purpose.
    pub group: Group,
    /// Its curve in a report, `chart.label`; none for switches and for details of a loss that are not weights.
    pub curve: Option<&'static str>,
    /// Its origin: paper or code.
    pub source: &'static str,
    /// Description; lines of a doc comment, each with a space before it.
    pub doc: &'static str,
}

/// 0 and up.
const NON_NEGATIVE: RangeInclusive<f64> = 0.0..=f64::MAX;

macro_rules! table {
    ($($(#[doc = $doc:literal])+ $param:ident { $($row:tt)+ })+) => {
        /// Values that can change over time; the rows of the table.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
        pub enum Param {
            $($(#[doc = $doc])+ $param,)+
        }

        impl Param {
            /// All of them, in the order of the rows.
            pub const ALL: [Param; [$(Param::$param),+].len()] = [$(Param::$param),+];
        }

        /// In the order of [`Param::ALL`].
        pub(super) static ROWS: [Row; Param::ALL.len()] = [
            $(Row { doc: concat!($($doc),+), $($row)+ },)+
        ];
    };
}

table! {
    /// Size of the training images relative to the data's.
    ImageScale {
        name: "image_scale",
        unit: "",
        default: 1.0,
        bounds: 0.01..=1.0,
        group: Group::Data,
        curve: Some("scale.image"),
        source: "Irradia; CurriculumGS downscales images for the loss instead (`coarse_weight`)",
    }
    /// SH bands in use.
    ShDegree {
        name: "sh_degree",
        unit: "degree",
        default: 0.0,
        bounds: 0.0..=3.0,
        group: Group::Splats,
        curve: Some("degree.SH"),
        source: "3DGS (Kerbl et al. 2023), section 5.1: one band more every 1000 steps",
    }
    /// Maximum number of splats, as a fraction of the recipe's cap.
    CountShare {
        name: "count_share",
        unit: "fraction",
        default: 1.0,
        bounds: 0.001..=1.0,
        group: Group::Data,
        curve: Some("count.allowed"),
        source: "Irradia",
    }
    /// Fraction of the visible splats whose position and shape are trained, the largest first; opacity and colour of all splats are
    /// trained.
    TrainedShare {
        name: "trained_share",
        unit: "fraction",
        default: 1.0,
        bounds: 0.001..=1.0,
        group: Group::Splats,
        curve: Some("count.trained"),
        source: "CurriculumGS: groups of parameters",
    }
    /// Weight of the photometric loss, (1 - w) L1 + w (1 - SSIM), where w is `ssim_weight`.
    PhotoWeight {
        name: "photo_weight",
        unit: "",
        default: 1.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.L1"),
        source: "3DGS (Kerbl et al. 2023), eq. 7",
    }
    /// w in the photometric loss: the weight of 1 - SSIM in it.
    SsimWeight {
        name: "ssim_weight",
        unit: "fraction",
        default: 0.0,
        bounds: 0.0..=1.0,
        group: Group::PartOf(Param::PhotoWeight),
        curve: Some("loss.SSIM"),
        source: "3DGS (Kerbl et al. 2023), eq. 7: lambda, 0.2",
    }
    /// Weight of the mean squared error.
    MseWeight {
        name: "mse_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.squared"),
        source: "Irradia",
    }
    /// Weight of the mean squared error of images downscaled by `coarse_factor`.
    CoarseWeight {
        name: "coarse_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.coarse"),
        source: "CurriculumGS",
    }
    /// Downscaling factor of the coarse loss.
    CoarseFactor {
        name: "coarse_factor",
        unit: "pixels",
        default: 4.0,
        bounds: 1.0..=64.0,
        group: Group::PartOf(Param::CoarseWeight),
        curve: None,
        source: "CurriculumGS",
    }
    /// Weight of LPIPS, on a crop of the image; skipped if its network weights are absent.
    PerceptualWeight {
        name: "perceptual_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.perceptual"),
        source: "LPIPS (Zhang et al. 2018); as a training loss CurriculumGS",
    }
    /// Weight of the mean |alpha - alpha of the photograph|, if it has alpha.
    AlphaWeight {
        name: "alpha_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.alpha"),
        source: "Irradia",
    }
    /// Weight of the mean |depth - depth of the points visible in the view|, relative to that depth; for a field, of the mean
    /// squared difference of distance, in the units in which its samples are spaced, at pixels with such points.
    DepthWeight {
        name: "depth_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.depth"),
        source: "CurriculumGS; for fields DS-NeRF (Deng et al. 2022)",
    }
    /// Weight of the edge-aware smoothness of disparity.
    SmoothWeight {
        name: "smooth_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.smooth"),
        source: "Godard et al. 2017; CurriculumGS",
    }
    /// Composite photographs with alpha, and the scene, over a new random colour in each step.
    RandomBackground {
        name: "random_background",
        unit: "",
        default: 0.0,
        bounds: 0.0..=1.0,
        group: Group::Switch,
        curve: None,
        source: "Instant-NGP and 3DGS, the authors' code: `random_background`",
    }
    /// Weight of the mean opacity.
    OpacityReg {
        name: "opacity_reg",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Regularizer,
        curve: Some("loss.opacity"),
        source: "3DGS-MCMC (Kheradmand et al. 2024), eq. 10",
    }
    /// Weight of the mean squared opacity.
    OpacitySquareReg {
        name: "opacity_square_reg",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Regularizer,
        curve: Some("loss.opacity squared"),
        source: "CurriculumGS",
    }
    /// Weight of the mean standard deviation, in units of `regularizers.unit`.
    ScaleReg {
        name: "scale_reg",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Regularizer,
        curve: Some("loss.size"),
        source: "3DGS-MCMC (Kheradmand et al. 2024), eq. 10",
    }
    /// Weight of the mean squared Frobenius norm of the covariance, in units of `regularizers.unit` to the fourth.
    CovarianceReg {
        name: "covariance_reg",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Regularizer,
        curve: Some("loss.covariance"),
        source: "CurriculumGS",
    }
    /// Largest condition number of a covariance; 0 for none.
    ConditionCap {
        name: "condition_cap",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Splats,
        curve: Some("cap.condition number"),
        source: "CurriculumGS",
    }
    /// Noise on the means of faint splats, as a factor on the means' rate and the splat's covariance in squared units of
    /// `regularizers.unit`.
    Noise {
        name: "noise",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Splats,
        curve: Some("noise.means"),
        source: "3DGS-MCMC (Kheradmand et al. 2024), eq. 8; `noise_lr` in the authors' code",
    }
    /// Learning rate of the means.
    RateMeans {
        name: "rate_means",
        unit: "extent / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Rate,
        curve: Some("rate.means"),
        source: "3DGS, the authors' code: `position_lr_init` to `position_lr_final`",
    }
    /// Learning rate of the quaternions.
    RateQuats {
        name: "rate_quats",
        unit: "1 / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Rate,
        curve: Some("rate.quaternions"),
        source: "3DGS, the authors' code: `rotation_lr`",
    }
    /// Learning rate of the ln scales.
    RateScales {
        name: "rate_scales",
        unit: "1 / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Rate,
        curve: Some("rate.scales"),
        source: "3DGS, the authors' code: `scaling_lr`",
    }
    /// Learning rate of the opacity logits.
    RateOpacities {
        name: "rate_opacities",
        unit: "1 / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Rate,
        curve: Some("rate.opacities"),
        source: "3DGS, the authors' code: `opacity_lr`",
    }
    /// Learning rate of the SH's DC coefficients.
    RateShDc {
        name: "rate_sh_dc",
        unit: "1 / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Rate,
        curve: Some("rate.SH, base"),
        source: "3DGS, the authors' code: `feature_lr`",
    }
    /// Learning rate of the other SH coefficients.
    RateShRest {
        name: "rate_sh_rest",
        unit: "1 / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Rate,
        curve: Some("rate.SH, rest"),
        source: "3DGS, the authors' code: `feature_lr` / 20",
    }
    /// Learning rate of a field's tables.
    RateTables {
        name: "rate_tables",
        unit: "1 / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Field,
        curve: Some("rate.tables"),
        source: "Instant-NGP (Mueller et al. 2022), section 4",
    }
    /// Learning rate of a field's networks.
    RateNets {
        name: "rate_nets",
        unit: "1 / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Field,
        curve: Some("rate.networks"),
        source: "NeRF (Mildenhall et al. 2020), section 5.3; Instant-NGP, section 4",
    }
    /// Learning rate of a field's appearance codes.
    RateCodes {
        name: "rate_codes",
        unit: "1 / step",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Field,
        curve: Some("rate.appearance codes"),
        source: "NeRF-W (Martin-Brualla et al. 2021)",
    }
    /// Weight of the interlevel loss, for a field with a proposal sampler.
    InterlevelWeight {
        name: "interlevel_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Field,
        curve: Some("loss.interlevel"),
        source: "mip-NeRF 360 (Barron et al. 2022), eq. 13",
    }
    /// Weight of the distortion loss of a field.
    DistortionWeight {
        name: "distortion_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Field,
        curve: Some("loss.distortion"),
        source: "mip-NeRF 360 (Barron et al. 2022), eq. 15",
    }
    /// Whether the residual field of a recipe that has one adds to the splats' colours; once on, it stays on for the rest of the run.
    Residual {
        name: "residual",
        unit: "",
        default: 1.0,
        bounds: 0.0..=1.0,
        group: Group::Switch,
        curve: None,
        source: "Irradia",
    }
    /// Learning rate of the photographs' exposures, if the recipe has `exposure`.
    RateExposure {
        name: "rate_exposure",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Socket,
        curve: Some("rate.exposure"),
        source: "Irradia: 0.03 falling to 0.001 if a recipe with `exposure` does not set it; Hierarchical 3DGS (Kerbl et al. 2024) uses 0.01 to 0.001 over 30,000 steps",
    }
    /// Weight of the mean squared difference of a photograph's exposure from the identity.
    ExposureReg {
        name: "exposure_reg",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Socket,
        curve: Some("loss.exposure"),
        source: "Irradia: 0.01 falling to 0.001 if a recipe with `exposure` does not set it",
    }
    /// Learning rate of the lenses' vignettes, if the recipe has `vignette`.
    RateVignette {
        name: "rate_vignette",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Socket,
        curve: Some("rate.vignette"),
        source: "Irradia: 0.01 falling to 0.001 if a recipe with `vignette` does not set it",
    }
    /// Learning rate of the colours of a sky behind the splats, a separate one for each photograph; 0: there is no sky.
    RateSky {
        name: "rate_sky",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Socket,
        curve: Some("rate.sky"),
        source: "Irradia",
    }
    /// Learning rate of the poses, in radians and in extents of the scene (at most the depth of what most views show), if the recipe has
    /// `refine_poses`.
    RatePoses {
        name: "rate_poses",
        unit: "radians, extents of the scene",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Socket,
        curve: Some("rate.poses"),
        source: "Irradia: 1e-3 falling to 1e-5 if a recipe with `refine_poses` does not set it; BARF (Lin et al. 2021) uses 1e-3 to 1e-5",
    }
    /// Weight of the mean 1 - alpha over unmasked pixels of photographs without alpha: everything that they show is a surface. A
    /// regulariser: it is not part of the reported loss.
    CoverWeight {
        name: "cover_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.cover"),
        source: "Irradia",
    }
    /// Weight of the sum of alpha over the pixels that masks leave out, divided by the number of all pixels: nothing is there. For masks
    /// that leave out all but an object.
    MaskWeight {
        name: "mask_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.mask"),
        source: "Irradia",
    }
    /// Weight of the mean |depth - depth of the map given with the photograph|, relative to that depth; for splats.
    DepthMapWeight {
        name: "depth_map_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.depth map"),
        source: "Hierarchical 3D Gaussians (Kerbl et al. 2024) with inverse depths; here depths, whatever the map contains",
    }
    /// Weight of the mean 1 - cosine between the normals of the rendered depth and those of the map given with the photograph; for splats.
    NormalMapWeight {
        name: "normal_map_weight",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Loss,
        curve: Some("loss.normal map"),
        source: "DN-Splatter (Turkulainen et al. 2024) with the normals of splats; here those of the rendered depth",
    }
    /// Learning rate of the photographs' grids of colour maps, if the recipe has `bilateral_grid`.
    RateBilateral {
        name: "rate_bilateral",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Socket,
        curve: Some("rate.bilateral grid"),
        source: "Irradia: 0.01 falling to 0.0005 if a recipe with `bilateral_grid` does not set it; gsplat uses 2e-3 to 2e-5 over 30,000 steps",
    }
    /// Weight of the total variation of a photograph's grid of colour maps: for each axis the mean squared difference of adjacent cells.
    BilateralTv {
        name: "bilateral_tv",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Socket,
        curve: Some("loss.bilateral variation"),
        source: "Irradia: 30 if a recipe with `bilateral_grid` does not set it; gsplat: 10, for a larger grid",
    }
    /// Largest standard deviation of a splat, relative to its distance from the camera of the step; 0 for none. For photographs of wide lenses
    /// that are not cut into faces it is at most 0.1.
    AngleCap {
        name: "angle_cap",
        unit: "",
        default: 0.0,
        bounds: NON_NEGATIVE,
        group: Group::Splats,
        curve: Some("cap.angle"),
        source: "Irradia",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::{Knob, Recipe, keys::keys};
    use crate::schedule::{Clock, plan};

    fn classic(overrides: &[String]) -> Recipe {
        Recipe::parse("classic", Recipe::built_in("classic").unwrap(), overrides).unwrap()
    }

    #[test]
    fn every_parameter_has_one_complete_row() {
        for param in Param::ALL {
            let row = param.row();
            let same = |text: fn(&Row) -> Option<&str>| ROWS.iter().filter(|other| text(other) == text(row)).count();
            assert_eq!(same(|row| Some(row.name)), 1, "{}", row.name);
            assert!(
                row.curve.is_none() || same(|row| row.curve) == 1,
                "{}: two curves with one name",
                row.name
            );
            assert!(row.bounds.contains(&row.default), "{}", row.name);
            assert!(row.doc.trim().ends_with('.') && !row.source.is_empty(), "{}", row.name);
            let plain = |c: char| c.is_ascii_lowercase() || c == '_';
            assert!(row.name.chars().all(plain), "{}", row.name);
            if let Group::PartOf(loss) = row.group {
                assert_eq!(loss.row().group, Group::Loss, "{}", row.name);
            }
        }
    }

    #[test]
    fn every_parameter_can_be_set_within_its_bounds_and_reaches_a_step() {
        for param in Param::ALL {
            let (name, bounds) = (param.name(), &param.row().bounds);
            let value = bounds.end().min(3.0);
            let recipe = classic(&[format!("params.{name}={value}")]);
            assert_eq!(recipe.params[&param], Knob::Const(value), "{name}");
            assert_eq!(plan(&recipe, &Clock::new(&recipe)).values[param], value, "{name}");
            for outside in [bounds.start() - 1.0, f64::NAN] {
                let overrides = [format!("params.{name}={outside:?}").replace("NaN", "nan")];
                let text = Recipe::built_in("classic").unwrap();
                let message = Recipe::parse("classic", text, &overrides).unwrap_err().to_string();
                assert!(message.contains(&format!("params.{name}: ")), "{message}");
            }
        }
    }

    #[test]
    fn every_parameter_is_listed_and_plotted() {
        let keys = keys();
        let page = include_str!("../report/page.js");
        for param in Param::ALL {
            let (row, path) = (param.row(), format!("params.{}", param.name()));
            assert_eq!(keys.iter().filter(|key| key.path == path).count(), 1, "{path}");
            match row.curve {
                Some(curve) => {
                    let (chart, label) = curve.split_once('.').expect("chart.label");
                    assert!(
                        page.contains(&format!("[\"{chart}\", ")) && !label.is_empty(),
                        "{curve} has no chart in page.js"
                    );
                }
                None => assert!(
                    matches!(row.group, Group::Switch | Group::PartOf(_)),
                    "{path} has no curve"
                ),
            }
        }
    }
}
