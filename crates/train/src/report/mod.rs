//! The results of a run: figures (`report.json`) and a page that shows them (`report.html`).
//!
//! The page is one file: style, script and data are embedded, pictures are named relative to it. It opens from disk
//! without a network.

mod columns;
mod machine;
mod schedule;

pub use columns::columns;
pub use machine::{Machine, machine, peak_rss_bytes};
pub use schedule::{Course, KnobCurve, Schedule, schedule};

use crate::times::Times;
use serde::{Deserialize, Deserializer, Serialize};

/// All results of a run. Numbers that are not finite are written as `null` and read back as NaN.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Version of the program.
    pub version: String,
    /// The device, such as `CPU, 2 threads, avx512`, preceded by the requested GPU, if any.
    pub device: String,
    /// The dataset, as the user named it.
    pub dataset: String,
    /// Name of the recipe.
    pub recipe: String,
    /// Hash of the resolved recipe, hexadecimal.
    pub recipe_hash: String,
    /// The resolved recipe.
    pub recipe_toml: String,
    /// Random seed of the run.
    pub seed: u64,
    /// Steps completed.
    pub steps: u64,
    /// Wall-clock seconds between the first step and the last; earlier versions wrote `training_seconds` here.
    #[serde(deserialize_with = "or_nan")]
    pub seconds: f64,
    /// Wall-clock seconds of the steps only.
    #[serde(default = "nan", deserialize_with = "or_nan")]
    pub training_seconds: f64,
    /// Breakdown of `seconds` and `total_seconds`.
    #[serde(default)]
    pub breakdown: Breakdown,
    /// CPU seconds of the steps only, all threads together.
    #[serde(deserialize_with = "or_nan")]
    pub cpu_seconds: f64,
    /// Wall-clock seconds of this process for the run, from reading the dataset to the last evaluation.
    #[serde(deserialize_with = "or_nan")]
    pub total_seconds: f64,
    /// Gaussians at the end.
    pub splats: u64,
    /// Number of parameters of the field, if the result is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parameters: Option<u64>,
    /// Peak memory of the process, bytes; 0 if the system does not report it.
    pub peak_rss_bytes: u64,
    /// The training and the evaluation background, in words.
    #[serde(default)]
    pub background: String,
    /// Mean over the held-out views, dB; NaN, and absent from files, if none could be measured.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub psnr: f64,
    /// Mean over the held-out views, each after the affine colour map that fits it best, dB; NaN, and absent from files, if none could be
    /// measured.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub psnr_corrected: f64,
    /// Mean over the held-out views; NaN, and absent from files, if none could be measured.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub ssim: f64,
    /// Mean over the held-out views; `None` without network weights.
    pub lpips: Option<f64>,
    /// The network of LPIPS: `squeeze`, `alex` or `vgg`.
    #[serde(default)]
    pub lpips_net: Option<String>,
    /// LPIPS of a network that training does not see, mean over the held-out views; `None` without its weights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unseen_lpips: Option<f64>,
    /// The network of that LPIPS.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unseen_lpips_net: Option<String>,
    /// The network whose LPIPS was part of the training loss, and so flatters this run; `None` if none was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trained_on_lpips: Option<String>,
    /// PSNR in dB over the right halves of the held-out views, after their exposure or pose was fitted on their left
    /// halves; `None` if the recipe trains neither.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub half_fit_psnr: Option<f64>,
    /// Brightness of the photographs' corners relative to the middle, sRGB-encoded, by the vignette that the run trained and
    /// its held-out views were evaluated with; `None` without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub corner_brightness: Option<f32>,
    /// The held-out views.
    pub views: Vec<ViewReport>,
    /// The stages of the recipe, in order.
    pub stages: Vec<StageReport>,
    /// Parameter curves over the run; empty in reports of versions without them.
    #[serde(default)]
    pub schedule: Schedule,
    /// Metrics over the run, in order of steps.
    pub curve: Vec<CurvePoint>,
    /// The machine.
    pub machine: Machine,
    /// Warnings of the run, one line each.
    pub warnings: Vec<String>,
}

/// Breakdown of wall-clock seconds. Those of `inside` add up to [`Report::seconds`]; those of `beside` are only this process's if
/// the run was resumed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Breakdown {
    /// Between the first step and the last.
    pub inside: InsideLoop,
    /// Before the first step and after the last.
    pub beside: OutsideLoop,
}

/// Wall-clock seconds between a run's first step and its last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct InsideLoop {
    /// The steps, without density control.
    pub steps: f64,
    /// Density control.
    pub density: f64,
    /// Loading photographs.
    pub loading: f64,
    /// Evaluating held-out views.
    pub evaluating: f64,
    /// Writing checkpoints.
    pub saving: f64,
    /// Paused.
    pub paused: f64,
    /// Events, forecasts, snapshots.
    pub other: f64,
}

/// Wall-clock seconds before a run's first step and after its last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OutsideLoop {
    /// Reading the dataset, creating or reading the initial state.
    pub preparing: f64,
    /// Writing and evaluating the scene.
    pub finishing: f64,
}

impl InsideLoop {
    /// The breakdown of `times` and the seconds of the steps.
    pub fn of(times: &Times, training_seconds: f64) -> Self {
        let Times {
            wall,
            loading,
            density,
            evaluating,
            saving,
            paused,
        } = *times;
        let named = training_seconds + loading + evaluating + saving + paused;
        Self {
            steps: training_seconds - density,
            density,
            loading,
            evaluating,
            saving,
            paused,
            other: wall - named,
        }
    }
}

/// One held-out view.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewReport {
    /// Name within the dataset.
    pub name: String,
    /// dB; NaN, and absent from files, if the view's mask excludes all pixels.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub psnr: f64,
    /// PSNR after the affine colour map that fits best, dB; NaN likewise.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub psnr_corrected: f64,
    /// Structural similarity; NaN, and absent from files, if the view's mask excludes all pixels.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub ssim: f64,
    /// Perceptual distance, if network weights are available.
    pub lpips: Option<f64>,
    /// Perceptual distance by a network that training does not see.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unseen_lpips: Option<f64>,
    /// PSNR in dB of the right half after a fit on the left half, if measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub half_fit_psnr: Option<f64>,
    /// Path of the photograph, relative to the report with forward slashes; empty if not written.
    pub truth: String,
    /// Path of the rendering, likewise.
    pub render: String,
    /// Path of their difference, likewise.
    pub error: String,
}

/// One stage of the recipe.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageReport {
    /// Its name in the recipe.
    pub name: String,
    /// Its first step.
    pub first_step: u64,
    /// Its last step.
    pub last_step: u64,
    /// Wall-clock seconds of the steps within it.
    #[serde(deserialize_with = "or_nan")]
    pub seconds: f64,
}

/// Metrics of one step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Steps completed.
    pub step: u64,
    /// Wall-clock seconds of the steps so far.
    #[serde(deserialize_with = "or_nan")]
    pub seconds: f64,
    /// Training loss; NaN, and absent from files, if only PSNR was measured.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub loss: f64,
    /// PSNR in dB, if measured at this step.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub psnr: Option<f64>,
    /// Gaussians.
    pub splats: u64,
}

fn nan() -> f64 {
    f64::NAN
}

fn is_nan(value: &f64) -> bool {
    value.is_nan()
}

fn or_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

const PAGE: &str = include_str!("page.html");
const SCRIPT: &str = include_str!("page.js");
/// Style of every page.
const STYLE: &str = include_str!("page.css");
/// Charts and image sliders of every page.
const WIDGETS: &str = include_str!("widgets.js");

/// The report as one HTML page, to be written beside the pictures that its views name.
///
/// All text is embedded as data that the script sets as text, never as markup.
pub fn to_html(report: &Report) -> String {
    fill_page(PAGE, "", SCRIPT, report)
}

/// `page` with the style, scripts and data inserted.
pub(crate) fn fill_page(page: &str, style: &str, script: &str, data: &impl Serialize) -> String {
    let data = serde_json::to_string(data).expect("plain data always serialises");
    // Within a script element only `<` can end the data (`</script>`, `<!--`); JSON strings may escape any character.
    let data = data.replace('<', "\\u003c");
    // The data is inserted last: it is not searched for placeholders.
    page.replace("/*STYLE*/", &format!("{STYLE}{style}"))
        .replace("/*SCRIPT*/", &format!("{WIDGETS}{script}"))
        .replace("/*DATA*/", &data)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn embedded(html: &str) -> serde_json::Value {
        let opening = "<script id=\"data\" type=\"application/json\">";
        let start = html.find(opening).expect("data element") + opening.len();
        let end = start + html[start..].find("</script>").expect("its end");
        serde_json::from_str(&html[start..end]).expect("JSON")
    }

    #[test]
    fn hostile_text_stays_data() {
        let evil = "</script><script>alert(1)</script><!-- /*SCRIPT*/ & \" ' \u{2028}";
        let report = Report {
            dataset: evil.into(),
            warnings: vec![evil.into()],
            views: vec![ViewReport {
                name: evil.into(),
                ..Default::default()
            }],
            ..Default::default()
        };
        let html = to_html(&report);
        assert!(!html.contains("<script>alert"));
        assert_eq!(html.matches("</script>").count(), 2, "data and program, nothing else");
        let value = embedded(&html);
        assert_eq!(value["dataset"], evil);
        assert_eq!(value["views"][0]["name"], evil);
    }

    #[test]
    fn non_finite_numbers_become_null_and_read_back_as_nan() {
        let report = Report {
            psnr: f64::NAN,
            ssim: f64::INFINITY,
            lpips: Some(f64::NAN),
            curve: vec![CurvePoint {
                loss: f64::NEG_INFINITY,
                ..Default::default()
            }],
            ..Default::default()
        };
        let value = embedded(&to_html(&report));
        assert!(value["psnr"].is_null() && value["ssim"].is_null() && value["lpips"].is_null());
        assert!(value["curve"][0]["loss"].is_null());
        let back: Report = serde_json::from_str(&serde_json::to_string(&report).expect("writes")).expect("reads");
        assert!(back.psnr.is_nan() && back.curve[0].loss.is_nan() && back.lpips.is_none());
    }

    #[test]
    fn a_report_reads_back_equal() {
        let report = Report {
            version: "0.1.0".into(),
            seed: u64::MAX,
            psnr: 31.25,
            lpips: Some(0.125),
            peak_rss_bytes: 123_456_789_012,
            stages: vec![StageReport {
                name: "grow".into(),
                first_step: 0,
                last_step: 499,
                seconds: 1.5,
            }],
            curve: vec![CurvePoint {
                step: 10,
                seconds: 0.5,
                loss: 0.1,
                psnr: Some(20.0),
                splats: 5,
            }],
            ..Default::default()
        };
        let text = serde_json::to_string_pretty(&report).expect("writes");
        assert_eq!(serde_json::from_str::<Report>(&text).expect("reads"), report);
    }

    #[test]
    fn the_page_uses_no_network() {
        let html = to_html(&Report::default());
        // The only URL allowed is the name of the SVG namespace, which is never fetched.
        let rest = html.replace("http://www.w3.org/2000/svg", "");
        for word in ["http://", "https://", "src=\"//", "@import", "url("] {
            assert!(!rest.contains(word), "{word}");
        }
        assert!(!html.contains("/*STYLE*/") && !html.contains("/*SCRIPT*/") && !html.contains("/*DATA*/"));
    }
}
