//! Published figures (`published.toml`), shown next to those of a comparison that follows the same protocol.

use super::{Comparison, Spread};
use crate::report::columns;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The figures of one method on one scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Published {
    /// The scene, as the comparison names it.
    pub scene: String,
    /// The method.
    pub method: String,
    /// The figures.
    #[serde(flatten)]
    pub figures: PublishedFigures,
    /// Where they were published.
    pub source: String,
}

/// Means over the held-out views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishedFigures {
    /// dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: Option<f64>,
    /// LPIPS of VGG16.
    pub lpips_vgg: Option<f64>,
}

#[derive(Deserialize)]
struct Table {
    method: Vec<Method>,
}

#[derive(Deserialize)]
struct Method {
    name: String,
    source: String,
    /// Protocol, scene, figures.
    #[serde(flatten)]
    protocols: BTreeMap<String, BTreeMap<String, PublishedFigures>>,
}

/// The published figures of the benchmark's scene `scene` under `protocol`; empty if there are none. The comparison names it `name`.
pub fn published(protocol: &str, scene: &str, name: &str) -> Vec<Published> {
    let table: Table = toml::from_str(include_str!("published.toml")).expect("a built-in table");
    let row = |method: Method| {
        let figures = *method.protocols.get(protocol)?.get(scene)?;
        Some(Published {
            scene: name.to_owned(),
            method: method.name,
            figures,
            source: method.source,
        })
    };
    table.method.into_iter().filter_map(row).collect()
}

/// Our rows and the published ones, scene by scene, below their headings; `None` without published ones.
pub(super) fn lines(comparison: &Comparison) -> Option<Vec<Vec<String>>> {
    let headings = ["scene", "method", "PSNR, dB", "SSIM", "LPIPS (vgg)"];
    let mut lines = vec![headings.map(str::to_owned).to_vec()];
    let cell = |value: Option<f64>, digits: usize| value.map_or("–".to_owned(), |v| format!("{v:.digits$}"));
    for scene in &comparison.scenes {
        let mut theirs = comparison.published.iter().filter(|p| p.scene == scene.name).peekable();
        if theirs.peek().is_none() {
            continue;
        }
        for entry in &scene.entries {
            let figures = entry.runs.iter().filter_map(|run| run.figures.as_ref());
            let vgg = Spread::from_values(figures.filter_map(|figures| figures.lpips_of("vgg")));
            let mean = |spread: Option<Spread>| spread.map(|spread| spread.mean);
            lines.push(vec![
                scene.name.clone(),
                format!("irradia {}", entry.recipe),
                cell(mean(entry.psnr), 2),
                cell(mean(entry.ssim), 3),
                cell(mean(vgg), 3),
            ]);
        }
        lines.extend(theirs.map(|p| {
            vec![
                p.scene.clone(),
                p.method.clone(),
                cell(Some(p.figures.psnr), 2),
                cell(p.figures.ssim, 3),
                cell(p.figures.lpips_vgg, 3),
            ]
        }));
    }
    (lines.len() > 1).then_some(lines)
}

/// The methods shown, each with its source.
pub(super) fn sources(comparison: &Comparison) -> Vec<String> {
    let mut sources: Vec<String> = Vec::new();
    for p in &comparison.published {
        let line = format!("{}: {}", p.method, p.source);
        if !sources.contains(&line) {
            sources.push(line);
        }
    }
    sources
}

/// The table with its sources, for a terminal; empty without published figures.
pub(super) fn to_text(comparison: &Comparison) -> String {
    let Some(lines) = lines(comparison) else {
        return String::new();
    };
    let mut text = format!("\nCompared with published figures:\n{}", columns(&lines, 2));
    for source in sources(comparison) {
        text += &format!("{source}\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean PSNR of a method over all its scenes of a protocol.
    fn mean(protocol: &str, method: &str) -> f64 {
        let table: Table = toml::from_str(include_str!("published.toml")).expect("a table");
        let method = table.method.iter().find(|m| m.name == method).expect("a method");
        let scenes = &method.protocols[protocol];
        scenes.values().map(|figures| figures.psnr).sum::<f64>() / scenes.len() as f64
    }

    #[test]
    fn the_rows_have_the_means_that_the_papers_print() {
        for (protocol, method, printed) in [
            ("blender", "NeRF", 31.01),
            ("llff", "NeRF", 26.50),
            ("blender", "instant-ngp", 33.18),
            ("blender", "Zip-NeRF", 33.10),
            ("mipnerf360", "Zip-NeRF", 28.54),
            ("blender", "3DGS", 33.32),
            ("tandt", "3DGS", 23.14),
            ("blender", "3DGS-MCMC", 33.80),
            ("tandt", "3DGS-MCMC", 24.29),
        ] {
            let found = mean(protocol, method);
            assert!((found - printed).abs() < 0.011, "{method} on {protocol}: {found}");
        }
    }

    #[test]
    fn a_scene_has_the_rows_of_its_protocol_only() {
        let rows = published("blender", "chair", "chair_2");
        let methods: Vec<&str> = rows.iter().map(|row| row.method.as_str()).collect();
        assert_eq!(methods, ["NeRF", "instant-ngp", "Zip-NeRF", "3DGS", "3DGS-MCMC"]);
        assert!(rows[3].figures.psnr == 35.83 && rows[3].scene == "chair_2");
        // Both LLFF and mip-NeRF 360 have a room.
        assert_eq!(published("llff", "room", "room")[0].figures.psnr, 32.70);
        assert_eq!(published("mipnerf360", "room", "room").len(), 3);
        assert!(published("blender", "teapot", "teapot").is_empty());
    }
}
