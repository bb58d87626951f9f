//! The files of the page: those of `page/`, as they are, and the program's own shaders.

use crate::kernels::kernels;

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const TEXT: &str = "text/plain; charset=utf-8";
const JSON: &str = "application/json";

/// The name under which the page fetches [`kernels`].
pub(crate) const KERNELS_FILE: &str = "shaders/kernels.json";

macro_rules! files {
    ($($kind:ident $name:literal,)*) => {
        &[$(($name, $kind, include_str!(concat!("../page/", $name))),)*]
    };
}

/// Name, content type and text.
const FILES: &[(&str, &str, &str)] = files![
    HTML "index.html",
    SCRIPT "js/camera.js",
    SCRIPT "js/chart.js",
    SCRIPT "js/commands.js",
    SCRIPT "js/connection.js",
    SCRIPT "js/dom.js",
    SCRIPT "js/edit/gizmo.js",
    SCRIPT "js/edit/overlay.js",
    SCRIPT "js/edit/placement.js",
    SCRIPT "js/edit/pointer.js",
    SCRIPT "js/edit/session.js",
    SCRIPT "js/edit/shapes.js",
    SCRIPT "js/edit/tools.js",
    SCRIPT "js/help.js",
    SCRIPT "js/hud.js",
    SCRIPT "js/icons.js",
    SCRIPT "js/local/assets.js",
    SCRIPT "js/local/device.js",
    SCRIPT "js/local/frame.js",
    SCRIPT "js/local/levels.js",
    SCRIPT "js/local/order.js",
    SCRIPT "js/local/renderer.js",
    SCRIPT "js/local/sort.js",
    SCRIPT "js/local/stream.js",
    SCRIPT "js/local/webgl.js",
    SCRIPT "js/local/webgpu.js",
    SCRIPT "js/main.js",
    SCRIPT "js/math.js",
    SCRIPT "js/navigation.js",
    SCRIPT "js/overlay.js",
    SCRIPT "js/panels/display.js",
    SCRIPT "js/panels/edit.js",
    SCRIPT "js/panels/path.js",
    SCRIPT "js/panels/training.js",
    SCRIPT "js/panels/views.js",
    SCRIPT "js/path.js",
    SCRIPT "js/share.js",
    SCRIPT "js/sidebar.js",
    SCRIPT "js/similarity.js",
    SCRIPT "js/stage.js",
    SCRIPT "js/state.js",
    SCRIPT "js/timeline.js",
    SCRIPT "js/toolbar.js",
    SCRIPT "js/units.js",
    SCRIPT "js/xr.js",
    TEXT "shaders/present.wgsl",
    TEXT "shaders/project.frag",
    TEXT "shaders/project.vert",
    TEXT "shaders/shape.frag",
    TEXT "shaders/splat.frag",
    TEXT "shaders/splat.vert",
    TEXT "shaders/unpack.wgsl",
    CSS "style/controls.css",
    CSS "style/layout.css",
    CSS "style/stage.css",
    CSS "style/theme.css",
];

/// Content type and text of a file.
pub(crate) fn file(name: &str) -> Option<(&'static str, &'static str)> {
    if name == KERNELS_FILE {
        return Some((JSON, kernels()));
    }
    FILES
        .iter()
        .find(|(known, ..)| *known == name)
        .map(|(_, kind, text)| (*kind, *text))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;
    use std::fs;
    use std::path::Path;

    #[test]
    fn every_file_of_the_page_is_served() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("page");
        let mut there = BTreeSet::new();
        let mut folders = vec![folder.clone()];
        while let Some(inner) = folders.pop() {
            for entry in fs::read_dir(inner).expect("the page") {
                let path = entry.expect("an entry").path();
                if path.is_dir() {
                    folders.push(path);
                } else {
                    let name = path
                        .strip_prefix(&folder)
                        .expect("inside")
                        .to_string_lossy()
                        .replace('\\', "/");
                    there.insert(name);
                }
            }
        }
        let served: BTreeSet<String> = FILES.iter().map(|(name, ..)| (*name).to_owned()).collect();
        assert_eq!(there, served);
        assert!(file("../src/page.rs").is_none() && file("").is_none());
    }
}
