//! Finds LPIPS weights, and `irradia lpips`, which imports them.

use crate::Usage;
use crate::terminal::{note, print_line};
use anyhow::{Context, Result, anyhow};
use irradia_measure::{ImportedTensor, Lpips, LpipsNet, to_weights_file};
use irradia_runs::HOW_TO_GET_LPIPS as LPIPS_HINT;
use irradia_runs::formats::{read_tensors, write_atomic};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The environment variable that names a weights file, or a folder of them.
const ENVIRONMENT_VARIABLE: &str = "IRRADIA_LPIPS";

#[derive(clap::Args)]
pub struct Args {
    /// Create a weights file from the authors' published files: torchvision's SqueezeNet 1.1, AlexNet or VGG16, and the LPIPS
    /// v0.1 heads of the same network (weights/v0.1/squeeze.pth, alex.pth or vgg.pth), each as .pth or .safetensors
    #[arg(long, num_args = 2, value_names = ["FEATURES", "HEADS"])]
    pub import: Option<Vec<PathBuf>>,
    /// Write the weights to this file instead of the user's data directory
    #[arg(long, value_name = "FILE", requires = "import")]
    pub out: Option<PathBuf>,
}

pub fn run(args: &Args) -> Result<()> {
    match args.import.as_deref() {
        Some([features, heads]) => import(features, heads, args.out.as_deref()),
        _ => print_found(),
    }
}

/// Prints which weights are found.
fn print_found() -> Result<()> {
    let mut found = false;
    for net in LpipsNet::ALL {
        if let Some(path) = find(None, Some(net)).unwrap_or(None) {
            found = true;
            print_line(format_args!("{:<8} {}", net.name(), path.display()))?;
        }
    }
    if found {
        return Ok(());
    }
    print_line(format_args!("no LPIPS weights found; {LPIPS_HINT}"))
}

fn import(features: &Path, heads: &Path, out: Option<&Path>) -> Result<()> {
    let mut tensors = BTreeMap::new();
    for (path, prefix) in [(features, "features."), (heads, "lin")] {
        let read = read_tensors(path, |name| name.starts_with(prefix))?;
        tensors.extend(read.into_iter().map(|(name, tensor)| {
            let (shape, values) = (tensor.shape, tensor.values);
            (name, ImportedTensor { shape, values })
        }));
    }
    let (net, bytes) = to_weights_file(&tensors)
        .map_err(|error| anyhow!("{} with {}: {error}", features.display(), heads.display()))?;
    let path = match out {
        Some(path) => path.to_owned(),
        None => {
            let folder = data_folder().context("the system has no user data directory; name a file with --out")?;
            std::fs::create_dir_all(&folder)
                .with_context(|| format!("cannot create {}; name a file with --out", folder.display()))?;
            folder.join(net.file_name())
        }
    };
    write_atomic(&path, |out| out.write_all(&bytes))?;
    print_line(format_args!("LPIPS of {net}: {}", path.display()))
}

/// Loads the LPIPS network, `net` if given, and prints its file; `None` if there is none.
pub fn lpips(given: Option<&PathBuf>, net: Option<LpipsNet>) -> Result<Option<Lpips>> {
    let Some(path) = find(given, net)? else { return Ok(None) };
    let lpips = Lpips::load(&path).context("LPIPS weights")?;
    if let Some(net) = net.filter(|net| *net != lpips.net()) {
        let (path, own) = (path.display(), lpips.net());
        return Err(Usage(format!(
            "{path} contains the weights of {own}, not {net}; name another file with --lpips"
        ))
        .into());
    }
    print_network(&lpips, &path);
    Ok(Some(lpips))
}

/// Prints which network is used, and its file.
pub fn print_network(lpips: &Lpips, path: &Path) {
    note(format_args!("LPIPS of {}: {}", lpips.net(), path.display()));
}

/// The file that [`lpips`] reads, absolute; of any network.
pub fn lpips_path(given: Option<&PathBuf>) -> Result<Option<PathBuf>> {
    find(given, None)
}

/// The file of a network other than that of `first`, used for scoring only: VGG's if it is found where weights are searched for, since
/// most papers on view synthesis report it, else AlexNet's. `None` if there is none, or `given` is a file.
pub fn unseen_lpips_path(given: Option<&PathBuf>, first: Option<&PathBuf>) -> Option<PathBuf> {
    let folder = match requested_path(given) {
        Some(path) if path.is_dir() => path,
        Some(_) => return None,
        None => data_folder()?,
    };
    let mut found = [LpipsNet::Vgg, LpipsNet::Alex]
        .into_iter()
        .filter_map(|net| find_in_folder(&folder, Some(net)));
    let path = found.find(|path| first.is_some_and(|first| first.file_name() != path.file_name()))?;
    Some(std::path::absolute(&path).unwrap_or(path))
}

/// Loads the network of [`unseen_lpips_path`], and prints which it is.
pub fn unseen_lpips(given: Option<&PathBuf>, first: &Lpips) -> Result<Option<Lpips>> {
    let Some(path) = unseen_lpips_path(given, Some(&first.net().file_name().into())) else {
        return Ok(None);
    };
    let lpips = Lpips::load(&path).context("LPIPS weights")?;
    print_network(&lpips, &path);
    Ok(Some(lpips))
}

/// What `--lpips` or `IRRADIA_LPIPS` names.
fn requested_path(given: Option<&PathBuf>) -> Option<PathBuf> {
    let variable = || std::env::var_os(ENVIRONMENT_VARIABLE).filter(|path| !path.is_empty());
    given.cloned().or_else(|| variable().map(PathBuf::from))
}

/// Searches `--lpips`, `IRRADIA_LPIPS`, then the user's data directory. A path to a file is used directly; in a folder, files are
/// found by their names, the first of [`LpipsNet::ALL`] unless a network is given.
fn find(given: Option<&PathBuf>, net: Option<LpipsNet>) -> Result<Option<PathBuf>> {
    let requested_path = requested_path(given);
    let missing = || match net {
        Some(net) => format!("LPIPS weights of {net} ({})", net.file_name()),
        None => "LPIPS weights".to_owned(),
    };
    let path = match &requested_path {
        Some(path) if path.is_dir() => {
            let found = find_in_folder(path, net);
            Some(found.ok_or_else(|| {
                Usage(format!(
                    "{} does not contain {}; {LPIPS_HINT}",
                    path.display(),
                    missing()
                ))
            })?)
        }
        Some(path) => Some(path.clone()),
        None => data_folder().and_then(|folder| find_in_folder(&folder, net)),
    };
    if let (None, Some(_)) = (&path, net) {
        return Err(Usage(format!("no {} found; {LPIPS_HINT}", missing())).into());
    }
    Ok(path.map(|path| std::path::absolute(&path).unwrap_or(path)))
}

fn find_in_folder(folder: &Path, net: Option<LpipsNet>) -> Option<PathBuf> {
    let mut nets = LpipsNet::ALL
        .into_iter()
        .filter(|other| net.is_none_or(|net| net == *other));
    nets.find_map(|net| Some(folder.join(net.file_name())).filter(|path| path.exists()))
}

/// `$XDG_DATA_HOME/irradia` or `~/.local/share/irradia`, and the equivalents on other systems.
fn data_folder() -> Option<PathBuf> {
    Some(dirs::data_local_dir()?.join("irradia"))
}
