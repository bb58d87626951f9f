//! A scene as one page that opens from disk, without a network, or as a folder for a web server.
//!
//! The page draws with the viewer's own modules and shaders; an import map names the modules, which are `data:` addresses, and shaders
//! are gzipped, in base64. The scene is the compact form of `compact.rs`, gzipped, in base64 or in a file beside the page.

use crate::ViewerError;
use crate::compact::compact;
use crate::page::{KERNELS_FILE, file};
use irradia_runs::formats::{gzip, write_atomic};
use irradia_runs::scene::base64;
use irradia_runs::{Film, Scene};
use irradia_splat::Splats;
use irradia_splat::levels::merged;
use serde_json::json;
use std::borrow::Cow;
use std::fs;
use std::path::Path;

/// Files of a shared folder.
const SCENE_FILE: &str = "scene.irs.gz";
const POSTER_FILE: &str = "poster.png";
/// Size of the start picture, which is drawn before the size of the page is known.
const POSTER_SIZE: (u32, u32) = (1280, 720);
/// Cameras per second of a flight that are stored in the page.
const KEYS_PER_SECOND: f32 = 5.0;
/// Maximum number of attempts to meet a limit of bytes by merging splats.
const MAX_TRIES: u32 = 5;

/// Modules of the page that draw, in `js/local/`.
const DRAWING_MODULES: [&str; 8] = [
    "device", "frame", "levels", "renderer", "sort", "stream", "webgl", "webgpu",
];
/// Their shaders, beside the program's own.
const SHADERS: [&str; 7] = [
    "shaders/project.vert",
    "shaders/project.frag",
    "shaders/splat.vert",
    "shaders/splat.frag",
    "shaders/shape.frag",
    "shaders/unpack.wgsl",
    "shaders/present.wgsl",
];

/// What to share, and how.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ShareOptions {
    /// Shown on the page and in the browser's tab.
    pub title: String,
    /// A line below the title, such as who made the scene.
    pub credits: String,
    /// Maximum number of bytes of the page with its scene.
    pub max_bytes: Option<u64>,
    /// A folder of page, scene and start picture instead of one page.
    pub folder: bool,
    /// A flight of the camera, which plays until the page is touched, and again when its button is pressed.
    pub path: Option<Film>,
}

/// What was written, and how much of the scene it contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shared {
    /// Bytes of all files.
    pub bytes: u64,
    /// Splats in the page, and of the scene that can be seen.
    pub splats: [usize; 2],
    /// Degree of their spherical harmonics, and of the scene's.
    pub degree: [u32; 2],
}

/// Writes `scene` as a page at `output`, or as the folder `output`.
///
/// # Errors
/// When the scene is a field, which the page cannot draw, or empty, a limit of bytes is too small for any scene, or a file cannot be
/// written.
pub fn share(scene: &Scene, output: &Path, options: &ShareOptions) -> Result<Shared, ViewerError> {
    let splats = scene.model.splats().ok_or(ViewerError::NoSplats)?;
    if splats.is_empty() {
        return Err(ViewerError::Empty);
    }
    // Bytes of the page without the splats' own.
    let around = page(scene, options, (!options.folder).then_some(&[])).len() as u64;
    let cost = |packed: &[u8]| {
        if options.folder {
            around + packed.len() as u64
        } else {
            around + (packed.len() as u64).div_ceil(3) * 4
        }
    };
    let PackedScene {
        packed,
        splats: counts,
        degree,
    } = pack_within(splats, scene.options.sh_degree, options.max_bytes, &cost)?;
    let shared = |bytes| Shared {
        bytes,
        splats: counts,
        degree: [degree, splats.sh_degree().min(scene.options.sh_degree)],
    };
    if !options.folder {
        let text = page(scene, options, Some(&packed));
        write_atomic(output, |out| out.write_all(text.as_bytes()))?;
        return Ok(shared(text.len() as u64));
    }
    fs::create_dir_all(output).map_err(|source| ViewerError::Folder {
        path: output.to_owned(),
        source,
    })?;
    let poster = output.join(POSTER_FILE);
    let camera = scene.orbit(1, Some(POSTER_SIZE))[0];
    irradia_runs::write_image(&poster, &scene.render(&camera).color)?;
    write_atomic(&output.join(SCENE_FILE), |out| out.write_all(&packed))?;
    let text = page(scene, options, None);
    write_atomic(&output.join("index.html"), |out| out.write_all(text.as_bytes()))?;
    let poster = fs::metadata(&poster).map_or(0, |metadata| metadata.len());
    Ok(shared(poster + packed.len() as u64 + text.len() as u64))
}

/// A scene's compact form.
struct PackedScene {
    /// Gzipped.
    packed: Vec<u8>,
    /// Splats in it, and of the whole scene.
    splats: [usize; 2],
    /// Degree of its harmonics.
    degree: u32,
}

/// The compact form that costs at most `max_bytes`: harmonics are left out first, then splats are merged.
fn pack_within(
    splats: &Splats,
    degree: u32,
    max_bytes: Option<u64>,
    cost: &dyn Fn(&[u8]) -> u64,
) -> Result<PackedScene, ViewerError> {
    let max_bytes = max_bytes.unwrap_or(u64::MAX);
    let highest = degree.min(splats.sh_degree());
    let mut last = (Vec::new(), 0);
    for degree in (0..=highest).rev() {
        let bytes = compact(splats, degree, usize::MAX);
        last = (gzip(&bytes), splat_count(&bytes));
        if cost(&last.0) <= max_bytes {
            return Ok(PackedScene {
                packed: last.0,
                splats: [last.1; 2],
                degree,
            });
        }
    }
    let all = last.1;
    let around = cost(&[]);
    let mut fewer = Cow::Borrowed(splats);
    for _ in 0..MAX_TRIES {
        let share = max_bytes.saturating_sub(around) as f64 / (cost(&last.0) - around) as f64;
        // A little less than the share, since fewer splats compress a little worse.
        let count = (last.1 as f64 * share * 0.98) as usize;
        if count == 0 {
            break;
        }
        fewer = Cow::Owned(merged(&fewer, count));
        let bytes = compact(&fewer, 0, usize::MAX);
        last = (gzip(&bytes), splat_count(&bytes));
        if cost(&last.0) <= max_bytes {
            return Ok(PackedScene {
                packed: last.0,
                splats: [last.1, all],
                degree: 0,
            });
        }
    }
    Err(ViewerError::TooSmall {
        bytes: max_bytes,
        around,
    })
}

/// The number of splats in a compact form.
fn splat_count(bytes: &[u8]) -> usize {
    u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]) as usize
}

/// The text of the page, with its scene or with the name of its file.
fn page(scene: &Scene, options: &ShareOptions, packed: Option<&[u8]>) -> String {
    let module = |name: &str| {
        let (_, text) = file(name).expect("a file of the page");
        // Modules import each other by relative paths; in one page they have only the names of the import map.
        ["../math", "./assets"]
            .into_iter()
            .map(str::to_owned)
            .chain(DRAWING_MODULES.map(|name| format!("./{name}")))
            .fold(text.to_owned(), |text, place| {
                let name = place.rsplit('/').next().unwrap_or_default();
                text.replace(&format!("\"{place}.js\""), &format!("\"irradia/{name}.js\""))
            })
    };
    let address = |text: &str| format!("data:text/javascript;base64,{}", base64::encode(text.as_bytes()));
    let mut imports = json!({
        "irradia/math.js": address(&module("js/math.js")),
        "irradia/assets.js": address(include_str!("../share/assets.js")),
    });
    for name in DRAWING_MODULES {
        imports[format!("irradia/{name}.js")] = address(&module(&format!("js/local/{name}.js"))).into();
    }
    let imports = json!({ "imports": imports });
    let mut texts = String::new();
    let mut text = |kind: &str, id: &str, text: &str| {
        texts += &format!("<script type=\"{kind}\" id=\"{id}\">{text}</script>\n");
    };
    let shaders: serde_json::Map<_, _> = SHADERS
        .into_iter()
        .chain([KERNELS_FILE])
        .map(|path| {
            let name = path.trim_start_matches("shaders/");
            (name.to_owned(), file(path).expect("a shader").1.into())
        })
        .collect();
    let shaders = gzip(json!(shaders).to_string().as_bytes());
    text("text/plain", "shaders", &base64::encode(&shaders));
    // A worker of a page opened from disk cannot be a module; its exports, which are for tests only, are removed.
    text(
        "text/plain",
        "order.js",
        &module("js/local/order.js").replace("\nexport ", "\n"),
    );
    text(
        "application/json",
        "view",
        &view(scene, options, packed.is_none() && options.folder).to_string(),
    );
    if let Some(packed) = packed {
        text("text/plain", "splats", &base64::encode(packed));
    }
    let poster = if options.folder {
        format!("<img class=\"poster\" src=\"{POSTER_FILE}\" alt=\"\">\n")
    } else {
        String::new()
    };
    // The texts last, so that no placeholder is searched for in them.
    include_str!("../share/page.html")
        .replace("{{title}}", &escaped(&options.title))
        .replace("{{credits}}", &escaped(&options.credits))
        .replace("{{poster}}", &poster)
        .replace("{{style}}", include_str!("../share/page.css"))
        .replace("{{main}}", include_str!("../share/main.js"))
        .replace("{{imports}}", &imports.to_string())
        .replace("{{texts}}", &texts)
}

/// What the page needs besides the splats: the camera of the first frame of `irradia render --orbit`, and the point it turns about.
fn view(scene: &Scene, options: &ShareOptions, in_file: bool) -> serde_json::Value {
    let camera = scene.orbit(1, None)[0];
    let orbit_geometry = scene.orbit_geometry();
    let k = camera.intrinsics;
    let rotation = camera.pose.rotation;
    let fov = 2.0 * (0.5 * k.height as f32 / k.fy).atan();
    json!({
        "start": {
            "position": camera.pose.position.to_array(),
            "rotation": [rotation.w, rotation.x, rotation.y, rotation.z],
            "fov": fov,
        },
        "aspect": k.width as f32 / k.height as f32,
        "pivot": orbit_geometry.center.to_array(),
        "up": orbit_geometry.up.to_array(),
        "radius": orbit_geometry.radius,
        "background": scene.options.background,
        "antialias": scene.options.antialias,
        "file": in_file.then_some(SCENE_FILE),
        "path": options.path.as_ref().map(path),
    })
}

/// A flight in the form that the page reads: a few cameras per second, between which it interpolates.
fn path(film: &Film) -> serde_json::Value {
    let step = (film.fps / KEYS_PER_SECOND).round().max(1.0) as usize;
    let last = film
        .cameras
        .last()
        .filter(|_| !(film.cameras.len() - 1).is_multiple_of(step));
    let keys = film.cameras.iter().step_by(step).chain(last).map(|camera| {
        let (p, q, k) = (camera.pose.position, camera.pose.rotation, &camera.intrinsics);
        let fov = 2.0 * (0.5 * k.height as f32 / k.fy).atan();
        [p.x, p.y, p.z, q.w, q.x, q.y, q.z, fov].map(|v| (f64::from(v) * 1e5).round() / 1e5)
    });
    json!({ "step": step as f32 / film.fps, "keys": keys.collect::<Vec<_>>() })
}

/// `text`, escaped for HTML.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
        .replace("{{", "{ {")
}

#[cfg(test)]
mod tests {
    use super::*;
    use irradia_runs::formats::{read_splats, write_splats};
    use irradia_runs::scene::{GaussianCloud, Rng};

    /// A scene of `count` splats of degree 2.
    fn scene(folder: &Path, count: usize) -> Scene {
        let mut rng = Rng::new(2, 1);
        let mut values = |n: usize| (0..n).map(|_| rng.range(-1.0, 1.0)).collect::<Vec<f32>>();
        let cloud = GaussianCloud {
            means: values(3 * count).as_chunks().0.to_vec(),
            quats: values(4 * count).as_chunks().0.to_vec(),
            log_scales: values(3 * count).as_chunks().0.to_vec(),
            opacity_logits: values(count),
            sh: values(27 * count),
            sh_degree: 2,
            ..GaussianCloud::default()
        };
        let path = folder.join("scene.ply");
        write_splats(&path, &cloud).expect("written");
        assert_eq!(read_splats(&path).expect("read").len(), count);
        Scene::read(&path).expect("read")
    }

    #[test]
    fn the_page_holds_everything_and_fetches_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = scene(folder.path(), 2000);
        let output = folder.path().join("scene.html");
        let options = ShareOptions {
            title: "A <b>bold</b> {{main}} title".into(),
            credits: "me & you".into(),
            ..ShareOptions::default()
        };
        let shared = share(&scene, &output, &options).expect("shared");
        let text = fs::read_to_string(&output).expect("written");
        assert!(text.contains("\"path\":null"));
        assert_eq!(
            (shared.bytes, shared.splats, shared.degree),
            (text.len() as u64, [2000, 2000], [2, 2])
        );
        assert!(text.contains("A &lt;b&gt;bold") && text.contains("me &amp; you"));
        for place in ["title", "credits", "poster", "style", "main", "imports", "texts"] {
            assert!(!text.contains(&format!("{{{{{place}}}}}")), "{place} is not filled in");
        }
        for place in ["src=", "href=", "http:", "https:", "\"./", "\"../"] {
            assert!(!text.contains(place), "{place}");
        }
        // One opening tag for each end: no text ends its element early.
        assert_eq!(text.matches("</script>").count(), text.matches("<script").count());
    }

    #[test]
    fn a_flight_is_a_few_cameras_a_second_and_ends_with_its_last() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = scene(folder.path(), 300);
        let film = Film::orbit(&scene, 32, None);
        let value = path(&film);
        let keys = value["keys"].as_array().expect("keys");
        // Every 6th of 30 frames a second: 0, 6, .. 30, and the last.
        assert_eq!(keys.len(), 7);
        assert!((value["step"].as_f64().expect("seconds") - 0.2).abs() < 1e-6);
        let position = film.cameras[31].pose.position;
        assert!((keys[6][1].as_f64().expect("y") - f64::from(position.y)).abs() < 1e-5);
    }

    #[test]
    fn a_limit_of_bytes_costs_harmonics_first_and_splats_then() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = scene(folder.path(), 20_000);
        let output = folder.path().join("scene.html");
        let try_with = |max_bytes: u64| {
            let options = ShareOptions {
                max_bytes: Some(max_bytes),
                ..ShareOptions::default()
            };
            share(&scene, &output, &options)
        };
        let whole = try_with(u64::MAX).expect("shared");
        let without = try_with(whole.bytes * 3 / 4).expect("shared");
        assert!(without.degree[0] < 2 && without.splats == [20_000; 2], "{without:?}");
        let fewer = try_with(whole.bytes / 4).expect("shared");
        assert!(
            fewer.degree[0] == 0 && fewer.splats[0] < 20_000 && fewer.bytes <= whole.bytes / 4,
            "{fewer:?}"
        );
        assert!(fewer.bytes > whole.bytes / 5, "{fewer:?}");
        let error = try_with(1000).expect_err("too small").to_string();
        assert!(error.contains("1000 bytes") && !error.contains('\n'), "{error}");
    }

    #[test]
    fn a_folder_has_page_scene_and_start_picture() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = scene(folder.path(), 300);
        let output = folder.path().join("site");
        let options = ShareOptions {
            folder: true,
            ..ShareOptions::default()
        };
        let shared = share(&scene, &output, &options).expect("shared");
        let size = |name: &str| fs::metadata(output.join(name)).expect("there").len();
        assert_eq!(shared.bytes, size("index.html") + size(SCENE_FILE) + size(POSTER_FILE));
        let text = fs::read_to_string(output.join("index.html")).expect("text");
        assert!(text.contains(SCENE_FILE) && text.contains(POSTER_FILE));
    }
}
