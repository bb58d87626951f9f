//! Every key of a recipe with its meaning: from the table of parameters, and from the documentation of the structs into which
//! a recipe is parsed.

use super::edit_distance;
use super::{
    AdamSettings, ClassicSettings, Exit, FastSettings, FieldSettings, Group, Ingredients, InitSettings, McmcSettings,
    MergeSettings, Param, Recipe, RegularizerSettings, RenderSettings, ResidualSettings, Stage, TamingSettings,
};
use std::collections::BTreeSet;

/// A key of a recipe.
#[derive(Clone, Debug, PartialEq)]
pub struct Key {
    /// The section's heading.
    pub section: String,
    /// As in `--set`, with `STAGE` for a stage's name.
    pub path: String,
    /// Unit or type of its value.
    pub value: String,
    /// Value if absent; `required` if it must be present.
    pub default: String,
    /// Allowed values; empty if the type says it all.
    pub bounds: String,
    /// Description, one line of Markdown.
    pub doc: String,
    /// Paper or code of its origin; empty if the built-in recipes name it beside their numbers.
    pub source: String,
}

/// A field of a struct that is parsed from a recipe.
#[derive(Debug)]
pub(crate) struct Documented {
    /// Name of the key.
    pub name: &'static str,
    /// Rust type.
    pub kind: &'static str,
    /// Serde attributes.
    pub serde: &'static str,
    /// Lines of a doc comment, each with a space before it.
    pub doc: &'static str,
}

/// A variant: its name, description and fields.
pub(crate) type Variant = (&'static str, &'static str, &'static [Documented]);

/// Defines a struct, or an enum of structs, and keeps the doc comments of its fields: `KEYS`, or `VARIANTS` with the keys of each.
/// A field's doc comment precedes its `serde` attribute.
macro_rules! documented {
    ($(#[$meta:meta])* pub struct $name:ident { $(
        $(#[doc = $doc:literal])+ $(#[serde($($serde:tt)*)])? pub $field:ident: $kind:ty,
    )+ }) => {
        $(#[$meta])*
        pub struct $name { $($(#[doc = $doc])+ $(#[serde($($serde)*)])? pub $field: $kind,)+ }

        impl $name {
            /// Its keys in a recipe.
            pub(crate) const KEYS: &'static [$crate::recipe::keys::Documented] = &[$(
                $crate::recipe::keys::Documented {
                    name: stringify!($field),
                    kind: stringify!($kind),
                    serde: stringify!($($($serde)*)?),
                    doc: concat!($($doc),+),
                },
            )+];
        }
    };
    ($(#[$meta:meta])* pub enum $name:ident { $(
        $(#[doc = $about:literal])+ $variant:ident { $($(#[doc = $doc:literal])+ $field:ident: $kind:ty,)+ },
    )+ }) => {
        $(#[$meta])*
        pub enum $name { $($(#[doc = $about])+ $variant { $($(#[doc = $doc])+ $field: $kind,)+ },)+ }

        impl $name {
            /// Its variants in a recipe.
            pub(crate) const VARIANTS: &'static [$crate::recipe::keys::Variant] = &[$(
                (stringify!($variant), concat!($($about),+), &[$(
                    $crate::recipe::keys::Documented {
                        name: stringify!($field),
                        kind: stringify!($kind),
                        serde: "",
                        doc: concat!($($doc),+),
                    },
                )+]),
            )+];
        }
    };
}
pub(super) use documented;

/// A doc comment without rustdoc's escapes.
fn prose(doc: &str) -> String {
    doc.trim().replace("\\[", "[").replace("\\]", "]")
}

impl Documented {
    fn key(&self, section: &str, table: &str) -> Key {
        let bare = self
            .kind
            .strip_prefix("Option<")
            .and_then(|kind| kind.strip_suffix('>'));
        let value = match bare.unwrap_or(self.kind) {
            "bool" => "true or false",
            "Choice" => "true, false or auto",
            "f32" | "f64" => "number",
            "u32" | "u64" | "usize" => "whole number",
            "String" => "text",
            "[f32; 3]" => "three numbers",
            "AdamKind" | "FieldSpace" | "LengthUnit" | "RegularizedKind" | "Represents" => "one word",
            "Vec<Stage>" => "tables",
            _ => "table",
        };
        let default = match (self.serde.starts_with("default"), self.kind) {
            (false, _) => "required",
            (true, "bool") if self.serde.contains("\"on\"") => "true",
            (true, "bool" | "Choice") => "false",
            (true, "f32" | "u32" | "u64" | "usize") => "0",
            (true, "AdamKind") => "sparse",
            (true, "FieldSpace") => "auto",
            (true, "LengthUnit") => "extent",
            (true, "RegularizedKind") => "visible",
            (true, "Represents") => "splats",
            (true, _) => "absent",
        };
        Key {
            section: section.to_owned(),
            path: [table, self.name].join(if table.is_empty() { "" } else { "." }),
            value: value.to_owned(),
            default: default.to_owned(),
            bounds: String::new(),
            doc: prose(self.doc),
            source: String::new(),
        }
    }
}

impl Param {
    fn key(self) -> Key {
        let row = self.row();
        let section = match row.group {
            Group::Data => "Parameters: data",
            Group::Splats => "Parameters: splats",
            Group::Loss | Group::PartOf(_) => "Parameters: losses",
            Group::Regularizer => "Parameters: regularisers",
            Group::Rate => "Parameters: learning rates of splats",
            Group::Field => "Parameters: radiance fields",
            Group::Socket => "Parameters: exposure, vignette, bilateral grid, sky and poses",
            Group::Switch => "Parameters: switches, on from 0.5",
        };
        let (low, high) = (row.bounds.start(), row.bounds.end());
        Key {
            section: section.to_owned(),
            path: format!("params.{}", row.name),
            value: if row.unit.is_empty() { "number" } else { row.unit }.to_owned(),
            default: row.default.to_string(),
            bounds: if *high == f64::MAX {
                format!("{low} and up")
            } else {
                format!("{low} to {high}")
            },
            doc: prose(row.doc),
            source: row.source.to_owned(),
        }
    }
}

/// All keys, section by section.
pub fn keys() -> Vec<Key> {
    let density = "stage.STAGE.density";
    let tables: [(&str, &str, &[Documented]); 14] = [
        ("The recipe", "", Recipe::KEYS),
        ("Rendering", "render", RenderSettings::KEYS),
        ("First splats", "init", InitSettings::KEYS),
        ("Adam", "adam", AdamSettings::KEYS),
        ("Regularisers", "regularizers", RegularizerSettings::KEYS),
        ("Ingredients of a curriculum", "ingredients", Ingredients::KEYS),
        ("Stages", "stage.STAGE", Stage::KEYS),
        (
            "Density control, `strategy = \"classic\"`",
            density,
            ClassicSettings::KEYS,
        ),
        ("Density control, `strategy = \"mcmc\"`", density, McmcSettings::KEYS),
        (
            "Density control, `strategy = \"taming\"`",
            density,
            TamingSettings::KEYS,
        ),
        ("Density control, `strategy = \"fast\"`", density, FastSettings::KEYS),
        ("Merging", "stage.STAGE.merge", MergeSettings::KEYS),
        ("Radiance field", "field", FieldSettings::KEYS),
        ("Residual field", "residual", ResidualSettings::KEYS),
    ];
    let of_tables = tables
        .iter()
        .flat_map(|(section, table, keys)| keys.iter().map(|key| key.key(section, table)));
    let of_exits = Exit::VARIANTS.iter().flat_map(|(name, about, keys)| {
        let when = name.to_lowercase();
        let section =
            format!("Early end of a stage by S, the mean L1 error over the training views: `when = \"{when}\"`");
        keys.iter().map(move |key| {
            let key = key.key(&section, "stage.STAGE.exit");
            let doc = format!("The stage ends when {} {}", about.trim(), key.doc);
            Key { doc, ..key }
        })
    });
    // Rows of one group, wherever they are in the table, are listed together.
    let params: Vec<Key> = Param::ALL.into_iter().map(Param::key).collect();
    let mut sections: Vec<&str> = params.iter().map(|key| key.section.as_str()).collect();
    let mut seen = BTreeSet::new();
    sections.retain(|section| seen.insert(*section));
    let of_params = sections
        .into_iter()
        .flat_map(|section| params.iter().filter(move |key| key.section == section));
    of_tables.chain(of_exits).chain(of_params.cloned()).collect()
}

/// The keys whose path or description contains `word`, ignoring case.
///
/// # Errors
/// When there is none: the path of the key with the nearest name.
pub fn find(word: &str) -> Result<Vec<Key>, String> {
    let small = word.to_lowercase();
    let has = |text: &str| text.to_lowercase().contains(&small);
    let (found, others): (Vec<Key>, Vec<Key>) = keys().into_iter().partition(|key| has(&key.path) || has(&key.doc));
    if !found.is_empty() {
        return Ok(found);
    }
    let name = |key: &Key| key.path.rsplit('.').next().map(str::to_owned).unwrap_or_default();
    let wanted = small.rsplit('.').next().unwrap_or(&small).to_owned();
    let nearest = others.into_iter().min_by_key(|key| edit_distance(&wanted, &name(key)));
    Err(nearest.map(|key| key.path).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::BUILT_IN;

    /// The paths of the keys in `value`, with `STAGE` for stages' names.
    fn paths(value: &toml::Value, path: &str, to: &mut BTreeSet<String>) {
        match value {
            toml::Value::Table(table) => {
                for (name, value) in table {
                    paths(
                        value,
                        [path, name].join(if path.is_empty() { "" } else { "." }).as_str(),
                        to,
                    );
                }
            }
            toml::Value::Array(items) if path == "stage" => {
                items.iter().for_each(|item| paths(item, "stage.STAGE", to));
            }
            _ => {
                to.insert(path.to_owned());
            }
        }
    }

    #[test]
    fn every_key_of_every_built_in_recipe_is_listed() {
        let listed: BTreeSet<String> = keys().into_iter().map(|key| key.path).collect();
        for (name, text) in BUILT_IN {
            let mut there = BTreeSet::new();
            paths(&text.parse().map(toml::Value::Table).unwrap(), "", &mut there);
            for path in there {
                let parts: Vec<&str> = path.split('.').collect();
                // The value of a curve, and the types of the field crate, are documented with the key above them.
                let known = (1..=parts.len()).any(|n| {
                    let path = parts[..n].join(".").replace("stage.STAGE.params.", "params.");
                    let is_table = ["params", "stage", "stage.STAGE.params"].contains(&path.as_str())
                        || keys().iter().any(|key| key.path.starts_with(&format!("{path}.")));
                    !is_table && listed.contains(&path)
                });
                let is_tag = path.ends_with(".strategy") || path.ends_with(".when");
                assert!(known || is_tag, "{name}: {path} is not listed");
            }
        }
    }

    #[test]
    fn every_key_is_documented_and_unique() {
        let keys = keys();
        for key in &keys {
            assert!(key.doc.ends_with('.') && key.doc.len() > 10, "{key:?}");
            assert!(!key.doc.contains("  ") && !key.section.is_empty(), "{key:?}");
            let same = keys
                .iter()
                .filter(|other| (&other.path, &other.section) == (&key.path, &key.section));
            assert_eq!(same.count(), 1, "{}", key.path);
        }
    }

    #[test]
    fn keys_are_found_by_a_part_of_their_name_and_the_nearest_is_suggested() {
        let found = find("SSIM").unwrap();
        assert!(
            found
                .iter()
                .any(|key| key.path == "params.ssim_weight" && key.bounds == "0 to 1")
        );
        assert_eq!(find("ssim_wieght").unwrap_err(), "params.ssim_weight");
        assert_eq!(find("params.rate_maens").unwrap_err(), "params.rate_means");
        let every = find("density.every").unwrap();
        assert_eq!(every.len(), 4, "one per strategy");
        let tau = find("exit.tau").unwrap();
        assert!(tau.len() == 1 && tau[0].section.contains("threshold"), "{tau:?}");
    }
}
