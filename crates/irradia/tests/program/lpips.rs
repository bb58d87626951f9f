//! LPIPS weights: imported from PyTorch files, found, and named in results.

use crate::process::*;
use irradia_testkit::{shared, torch};
use safetensors::SafeTensors;
use std::fs;
use std::path::Path;

/// Features and heads of the shared weights, in the form of torchvision's and the LPIPS authors' files.
fn publish(weights: &Path, folder: &Path) {
    let bytes = fs::read(weights).expect("the weights");
    let file = SafeTensors::deserialize(&bytes).expect("whole");
    let values = |data: &[u8]| {
        data.as_chunks()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b))
            .collect::<Vec<_>>()
    };
    let tensors: Vec<_> = file
        .iter()
        .map(|(name, t)| (name, t.shape().to_vec(), values(t.data())))
        .collect();
    let part = |prefix: &str| -> Vec<torch::NamedTensor> {
        let part = tensors.iter().filter(|(name, ..)| name.starts_with(prefix));
        part.map(|(name, shape, values)| (*name, &shape[..], &values[..]))
            .collect()
    };
    let mut features = part("features.");
    features.push(("classifier.1.bias", &[2], &[1.0, 2.0]));
    fs::write(folder.join("features.pth"), torch::archive(&features)).expect("written");
    fs::write(folder.join("heads.pth"), torch::stream(&part("lin"))).expect("written");
}

#[test]
fn weights_are_imported_found_and_named() {
    let [Some(squeeze), Some(alex)] =
        ["squeeze", "alex"].map(|net| shared(&format!("data/lpips/lpips_{net}.safetensors")))
    else {
        return;
    };
    let folder = with_run();
    let here = folder.path();
    assert!(
        irradia(here, "lpips")
            .success()
            .stdout
            .contains("no LPIPS weights found")
    );
    let without = irradia(here, "eval run --data data").success();
    assert_eq!(
        without.stderr.matches("LPIPS is not measured").count(),
        1,
        "{without:?}"
    );
    irradia(here, "eval run --data data --lpips-net alex").refused(2, &["lpips_alex.safetensors", "--import"]);

    irradia(here, "train data --recipe curriculum --steps 2 --out without").success();
    for weights in [&squeeze, &alex] {
        publish(weights, here);
        irradia(here, "lpips --import features.pth heads.pth").success();
    }
    let listed = irradia(here, "lpips").success().stdout;
    assert!(listed.contains("squeeze") && listed.contains("lpips_alex.safetensors") && !listed.contains("vgg"));
    // The same tensors as in the original file.
    let [got, want] =
        [here.join("share/irradia/lpips_alex.safetensors"), alex.clone()].map(|path| fs::read(path).unwrap());
    let [got, want] = [&got, &want].map(|bytes| SafeTensors::deserialize(bytes).unwrap());
    assert_eq!(got.len(), want.len());
    for (name, tensor) in want.iter() {
        let imported = got.tensor(name).unwrap();
        assert!(
            imported.shape() == tensor.shape() && imported.data() == tensor.data(),
            "{name}"
        );
    }

    // A perceptual loss does not begin in the middle of a run.
    unfinish(&here.join("without"), "scene.ply");
    let ended = irradia(here, "train --resume without").success();
    assert!(!ended.stderr.contains("LPIPS of"), "{ended:?}");

    let measure = |more: &str| {
        let ended = irradia(here, &format!("eval run --data data --json figures.json {more}")).success();
        let figures = json(&here.join("figures.json"));
        // A second network only if none is requested.
        let networks = if figures["unseen_lpips"].is_null() { 1 } else { 2 };
        assert_eq!(ended.stderr.matches("LPIPS of ").count(), networks, "{ended:?}");
        let net = figures["lpips_net"].as_str().expect("a network").to_owned();
        assert!(ended.stdout.contains(&format!("LPIPS ({net}) ")), "{ended:?}");
        (net, figures["lpips"].as_f64().expect("a number"))
    };
    let (net, by_squeeze) = measure("");
    assert_eq!(net, "squeeze");
    let both = json(&here.join("figures.json"));
    let (net, by_alex) = measure("--lpips-net alex");
    assert!(net == "alex" && by_alex != by_squeeze);
    assert!(both["unseen_lpips_net"] == "alex" && both["unseen_lpips"] == by_alex);
    assert!(json(&here.join("figures.json"))["unseen_lpips"].is_null());
    // A file's network is recognised by its tensors, files in a folder by name.
    assert_eq!(
        measure(&format!("--lpips {}", alex.display())),
        ("alex".to_owned(), by_alex)
    );
    let given = alex.parent().unwrap().display().to_string();
    assert_eq!(
        measure(&format!("--lpips {given} --lpips-net alex")),
        ("alex".to_owned(), by_alex)
    );

    let name = alex.display().to_string();
    irradia_with(here, "eval run --data data --lpips-net squeeze --lpips", &[&name]).refused(2, &["alex", "squeeze"]);
    irradia(here, "eval run --data data --lpips-net vgg --lpips share/irradia").refused(2, &["lpips_vgg.safetensors"]);
    irradia(here, "eval run --data data --lpips-net vgg16").refused(2, &["squeeze, alex or vgg"]);
    // Features of one network combined with the heads of another.
    publish(&squeeze, here);
    fs::copy(here.join("heads.pth"), here.join("other.pth")).unwrap();
    publish(&alex, here);
    irradia(here, "lpips --import features.pth other.pth --out x.safetensors")
        .refused(1, &["lin1.model.1.weight", "other.pth"]);
    irradia(here, "lpips --import heads.pth heads.pth").refused(1, &["no features of SqueezeNet"]);
    irradia(here, "lpips --import run/report.json heads.pth").refused(1, &["run/report.json", "neither a PyTorch"]);
    assert!(!here.join("x.safetensors").exists());
}
