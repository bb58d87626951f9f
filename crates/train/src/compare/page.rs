//! The comparison as one page: style, script, data and pictures are embedded, so that it opens from disk without a network and
//! can be shared as one file.

use super::Comparison;
use crate::report::fill_page;
use irradia_scene::base64;

const PAGE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");

/// The page; all text is embedded as data that the script sets as text, never as markup.
pub fn to_html(comparison: &Comparison) -> String {
    fill_page(PAGE, STYLE, SCRIPT, comparison)
}

/// A JPEG file as a `data:` URL.
pub fn picture(jpeg: &[u8]) -> String {
    format!("data:image/jpeg;base64,{}", base64::encode(jpeg))
}
