//! What a run came to: the figures (`report.json`) and a page that shows them (`report.html`).
//!
//! The page is one file: style, script and data are inside it, pictures are named relative to it. It opens from disk
//! with no network.

mod columns;
mod machine;
mod schedule;

pub use columns::columns;
pub use machine::{Machine, machine, peak_rss_bytes};
pub use schedule::{KnobCurve, Schedule, schedule};

use crate::times::Times;
use serde::{Deserialize, Deserializer, Serialize};

/// Everything a run is judged by. Numbers that are not finite are written as `null` and read back as NaN.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Version of the program.
    pub version: String,
    /// What computed, such as `cpu, 2 threads, avx512`.
    pub device: String,
    /// The dataset, as the user named it.
    pub dataset: String,
    /// Name of the recipe.
    pub recipe: String,
    /// Hash of the resolved recipe, hexadecimal.
    pub recipe_hash: String,
    /// The resolved recipe.
    pub recipe_toml: String,
    /// Seed of the run.
    pub seed: u64,
    /// Steps taken.
    pub steps: u64,
    /// Wall-clock seconds of everything between the first step and the last; earlier versions told `training_seconds` here.
    #[serde(deserialize_with = "or_nan")]
    pub seconds: f64,
    /// Wall-clock seconds of the steps alone.
    #[serde(default = "nan", deserialize_with = "or_nan")]
    pub training_seconds: f64,
    /// What `seconds` and `total_seconds` went into.
    #[serde(default)]
    pub breakdown: Breakdown,
    /// Processor seconds of the steps alone, all threads together.
    #[serde(deserialize_with = "or_nan")]
    pub cpu_seconds: f64,
    /// Wall-clock seconds of everything that this process did for the run, from reading the dataset to the last evaluation.
    #[serde(deserialize_with = "or_nan")]
    pub total_seconds: f64,
    /// Gaussians at the end.
    pub splats: u64,
    /// Numbers of the field, where the run made one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parameters: Option<u64>,
    /// Most memory the process ever held, bytes; 0 where the system does not say.
    pub peak_rss_bytes: u64,
    /// What it was trained over and is scored over, for people.
    #[serde(default)]
    pub background: String,
    /// Mean over the held-out views, dB; NaN, and absent from files, where none could be measured.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub psnr: f64,
    /// Mean over the held-out views, likewise.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub ssim: f64,
    /// Mean over the held-out views; `None` without the network's weights.
    pub lpips: Option<f64>,
    /// The network whose features it compares: `squeeze`, `alex` or `vgg`.
    #[serde(default)]
    pub lpips_net: Option<String>,
    /// PSNR in dB over the right halves of the held-out views, after their exposure or pose was fitted on their left
    /// halves; `None` where the recipe learns neither.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub half_fit_psnr: Option<f64>,
    /// The held-out views.
    pub views: Vec<ViewReport>,
    /// The stages of the recipe, in order.
    pub stages: Vec<StageReport>,
    /// The knobs over the run; empty in reports of versions that did not write it.
    #[serde(default)]
    pub schedule: Schedule,
    /// How the run went, in order of steps.
    pub curve: Vec<CurvePoint>,
    /// Where it ran.
    pub machine: Machine,
    /// What went wrong without ending the run, one line each.
    pub warnings: Vec<String>,
}

/// Wall-clock seconds by what they were spent on. Those of `inside` add up to [`Report::seconds`]; those of `beside` are this
/// process's own, where a run was resumed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Breakdown {
    /// Between the first step and the last.
    pub inside: Inside,
    /// Before the first step and after the last.
    pub beside: Beside,
}

/// Wall-clock seconds between a run's first step and its last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Inside {
    /// The steps, without density control.
    pub steps: f64,
    /// Density control.
    pub density: f64,
    /// Waiting for photographs.
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
pub struct Beside {
    /// Reading the dataset, making or reading the first state.
    pub preparing: f64,
    /// Writing the scene, evaluating it.
    pub finishing: f64,
}

impl Inside {
    /// What `times` and the seconds of the steps say.
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
    /// dB; NaN, and absent from files, where the view's mask leaves no pixel.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub psnr: f64,
    /// Structural similarity, likewise.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub ssim: f64,
    /// Perceptual distance, where there are weights.
    pub lpips: Option<f64>,
    /// PSNR in dB of the right half after a fit on the left half, where the report has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub half_fit_psnr: Option<f64>,
    /// The photograph, a path relative to the report with forward slashes; empty where none was written.
    pub truth: String,
    /// The rendering, likewise.
    pub render: String,
    /// Their difference, likewise.
    pub error: String,
}

/// One stage of the recipe.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StageReport {
    /// As the recipe names it.
    pub name: String,
    /// Its first step.
    pub first_step: u64,
    /// Its last step.
    pub last_step: u64,
    /// Wall-clock seconds of the steps within it.
    #[serde(deserialize_with = "or_nan")]
    pub seconds: f64,
}

/// The run at one step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Steps taken.
    pub step: u64,
    /// Wall-clock seconds of the steps so far.
    #[serde(deserialize_with = "or_nan")]
    pub seconds: f64,
    /// Training loss; NaN, and absent from files, where only PSNR was measured.
    #[serde(default = "nan", deserialize_with = "or_nan", skip_serializing_if = "is_nan")]
    pub loss: f64,
    /// PSNR in dB, where it was measured at this step.
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
/// What every page looks like.
const STYLE: &str = include_str!("page.css");
/// Charts and dividers, for every page.
const WIDGETS: &str = include_str!("widgets.js");

/// The report as one HTML page, for a file beside the pictures its views name.
///
/// All text reaches the page as data that the script sets as text, never as markup.
pub fn to_html(report: &Report) -> String {
    filled(PAGE, "", SCRIPT, report)
}

/// `page` with what all pages share, what this one adds to the style, its script, and its data.
pub(crate) fn filled(page: &str, style: &str, script: &str, data: &impl Serialize) -> String {
    let data = serde_json::to_string(data).expect("plain data always serialises");
    // Within a script element only `<` can end the data (`</script>`, `<!--`); JSON strings may escape any character.
    let data = data.replace('<', "\\u003c");
    // The data goes in last: nothing in it is looked at for marks.
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
    fn what_is_not_finite_becomes_null_and_comes_back_as_nan() {
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
    fn the_page_asks_nothing_of_the_network() {
        let html = to_html(&Report::default());
        // The one address allowed is the name of the SVG namespace, which is never fetched.
        let rest = html.replace("http://www.w3.org/2000/svg", "");
        for word in ["http://", "https://", "src=\"//", "@import", "url("] {
            assert!(!rest.contains(word), "{word}");
        }
        assert!(!html.contains("/*STYLE*/") && !html.contains("/*SCRIPT*/") && !html.contains("/*DATA*/"));
    }
}
