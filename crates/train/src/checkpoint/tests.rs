use super::*;
use crate::recipe::{Param, Values};
use crate::socket;
use glam::Vec3;
use irradia_scene::{Camera, Intrinsics, Photo, PointCloud, Pose, View};
use safetensors::tensor::TensorView;

/// Two grey photographs and a few points.
pub(crate) fn dataset() -> Arc<Dataset> {
    let positions: Vec<Vec3> = (0..12)
        .map(|i| Vec3::new(i as f32 * 0.1, (i % 3) as f32 * 0.1, 2.0))
        .collect();
    let views = [0.0, 1.0].map(|x| {
        View::new(
            format!("view {x}"),
            Camera::new(
                Pose::look_at(Vec3::X * x, 2.0 * Vec3::Z, Vec3::NEG_Y),
                Intrinsics::from_fov_x(8, 8, 1.0),
            ),
            Arc::new(Photo {
                width: 8,
                height: 8,
                channels: 3,
                data: vec![128; 3 * 8 * 8],
                mask: None,
            }),
        )
    });
    Arc::new(Dataset {
        views: views.into(),
        train: vec![0, 1],
        points: Some(PointCloud {
            colors: vec![[128; 3]; positions.len()],
            positions,
        }),
        ..Dataset::default()
    })
}

/// A trainer whose clock carries a different value of each parameter, all within bounds.
fn trainer() -> Trainer {
    let recipe = Recipe::parse("classic", Recipe::built_in("classic").unwrap(), &[]).unwrap();
    let mut trainer = Trainer::new(dataset(), recipe, TrainOptions::default()).unwrap();
    trainer.clock.carried = Values::from_fn(|param| param.row().default + 0.001 * (1.0 + param as usize as f64));
    trainer.clock.step = 7;
    trainer
}

type Tensors = Vec<(String, Dtype, Vec<usize>, Vec<u8>)>;

/// `bytes` as format `format`, with its tensors modified by `change`.
fn rewritten(bytes: &[u8], format: &str, change: impl Fn(&mut Tensors)) -> Vec<u8> {
    let file = SafeTensors::deserialize(bytes).unwrap();
    let (_, header) = SafeTensors::read_metadata(bytes).unwrap();
    let mut metadata = header.metadata().clone().unwrap();
    metadata.insert("format".into(), format.into());
    let tensors = file.iter();
    let mut tensors: Tensors = tensors
        .map(|(name, view)| {
            (
                name.to_owned(),
                view.dtype(),
                view.shape().to_vec(),
                view.data().to_vec(),
            )
        })
        .collect();
    change(&mut tensors);
    let views = tensors
        .iter()
        .map(|(name, dtype, shape, bytes)| (name, TensorView::new(*dtype, shape.clone(), bytes).unwrap()));
    safetensors::serialize(views, Some(metadata)).unwrap()
}

fn read(bytes: &[u8]) -> Result<Trainer, String> {
    from_bytes(bytes, dataset(), TrainOptions::default()).map_err(|error| error.to_string())
}

/// Removes the values by name and appends `count` of `values` to the clock's numbers, as in format 4.
fn unname(tensors: &mut Tensors, values: &Values, count: usize) {
    tensors.retain(|(name, ..)| !name.starts_with("carried."));
    let (.., shape, bytes) = tensors.iter_mut().find(|(name, ..)| name == "clock.real").unwrap();
    let in_order = Param::ALL.iter().take(count);
    bytes.extend(in_order.flat_map(|param| values[*param].to_le_bytes()));
    shape[0] += count;
}

#[test]
fn a_checkpoint_round_trips() {
    let trainer = trainer();
    let again = read(&to_bytes(&trainer)).unwrap();
    assert_eq!(again.clock, trainer.clock);
    assert_eq!(again.engine.state().splats, trainer.engine.state().splats);
}

#[test]
fn photographs_that_were_left_out_and_what_was_hidden_stay_so() {
    let mut trainer = trainer();
    assert_eq!(trainer.trained, [0, 1]);
    trainer.trained = vec![1];
    assert_eq!(read(&to_bytes(&trainer)).unwrap().trained, [1]);
    // Files from before photographs could be left out train on all.
    let older = rewritten(&to_bytes(&trainer), FORMAT, |tensors| {
        tensors.retain(|(name, ..)| name != TRAINED_TENSOR)
    });
    assert_eq!(read(&older).unwrap().trained, [0, 1]);

    let cameras = trainer.dataset.clone();
    trainer.hidden = Hidden::from_pairs(&[0, 5, 1, 7], |view| Some(&cameras.views[view].camera)).unwrap();
    let bytes = to_bytes(&trainer);
    assert_eq!(read(&bytes).unwrap().hidden, trainer.hidden);
    let elsewhere = rewritten(&bytes, FORMAT, |tensors| {
        let (.., pairs) = tensors.iter_mut().find(|(name, ..)| name == HIDDEN_TENSOR).unwrap();
        pairs[0] = 9;
    });
    assert!(read(&elsewhere).err().unwrap().contains("hidden_blocks"));
}

#[test]
fn a_streamed_checkpoint_has_the_bytes_of_the_format_and_a_copy_is_that_of_its_moment() {
    let mut trainer = trainer();
    let bytes = to_bytes(&trainer);
    let data = |bytes: &[u8]| bytes[8 + u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize..].to_vec();
    // The library's own file of the same tensors; metadata, a map without order, may differ.
    let theirs = rewritten(&bytes, FORMAT, |_| ());
    let order = |bytes: &[u8]| SafeTensors::read_metadata(bytes).unwrap().1.offset_keys();
    assert_eq!(order(&bytes), order(&theirs));
    assert!(data(&bytes) == data(&theirs) && bytes.len() == theirs.len());
    let copy = Checkpoint::of(&trainer).copied_into(SplatState::default());
    trainer.step(&mut Vec::new()).unwrap();
    let mut later = Vec::new();
    copy.write(&mut later).unwrap();
    assert!(data(&later) == data(&bytes) && data(&to_bytes(&trainer)) != data(&bytes));
}

#[test]
fn socket_occupants_resume_exactly() {
    let overrides = [
        "exposure=true",
        "bilateral_grid=true",
        "vignette=true",
        "refine_poses=true",
        "params.rate_poses=0.001",
        "params.rate_sky=0.05",
        "params.rate_codes=0.05",
    ]
    .map(str::to_owned);
    let recipe = Recipe::parse("shiny", Recipe::built_in("shiny").unwrap(), &overrides).unwrap();
    let mut trainer = Trainer::new(dataset(), recipe, TrainOptions::default()).unwrap();
    for _ in 0..3 {
        trainer.step(&mut Vec::new()).unwrap();
    }
    let bytes = to_bytes(&trainer);
    let mut again = read(&bytes).unwrap();
    let occupants = again.sockets.occupants();
    let names: Vec<&str> = occupants.iter().map(|occupant| occupant.name()).collect();
    assert_eq!(names.len(), socket::FILES.len(), "{names:?}");
    for (name, file) in names.iter().zip(socket::FILES) {
        assert_eq!(file, format!("{name}.safetensors"));
    }
    let learnt = [&mut trainer, &mut again].map(|trainer| {
        trainer.step(&mut Vec::new()).unwrap();
        let occupants = trainer.sockets.occupants().into_iter();
        let tensors: Vec<_> = occupants.flat_map(|occupant| occupant.tensors()).collect();
        (trainer.engine.state().clone(), tensors, trainer.camera(0))
    });
    assert!(learnt[0] == learnt[1], "a resumed run equals the uninterrupted one");
    assert!(learnt[0].2 != trainer.dataset.views[0].camera, "poses have moved");
    let without = rewritten(&bytes, FORMAT, |tensors| {
        tensors.retain(|(name, ..)| name != "exposure.maps");
    });
    let error = read(&without).err().expect("a tensor is missing");
    assert!(error.contains("exposure.maps is missing"), "{error}");
}

#[test]
fn format_4_is_read_as_format_5() {
    let trainer = trainer();
    let bytes = to_bytes(&trainer);
    let old = rewritten(&bytes, "irradia-checkpoint-4", |tensors| {
        unname(tensors, &trainer.clock.carried, 32);
    });
    let again = read(&old).unwrap();
    // Parameters newer than format 4 have their defaults.
    let mut clock = trainer.clock.clone();
    for param in Param::ALL.into_iter().skip(32) {
        clock.carried[param] = param.row().default;
    }
    assert_eq!(again.clock, clock);
    assert_eq!(again.engine.state().splats, trainer.engine.state().splats);
    let short = rewritten(&bytes, "irradia-checkpoint-4", |tensors| {
        unname(tensors, &trainer.clock.carried, 31);
    });
    assert!(read(&short).err().is_some_and(|error| error.contains("wrong length")));
}

#[test]
fn a_parameter_newer_than_the_checkpoint_has_its_default() {
    let trainer = trainer();
    let old = rewritten(&to_bytes(&trainer), FORMAT, |tensors| {
        tensors.retain(|(name, ..)| name != "carried.coarse_factor");
    });
    let clock = read(&old).unwrap().clock;
    assert_eq!(clock.carried[Param::CoarseFactor], 4.0);
    assert_eq!(
        clock.carried[Param::SsimWeight],
        trainer.clock.carried[Param::SsimWeight]
    );
}

#[test]
fn an_unknown_parameter_is_rejected_by_name() {
    let bytes = to_bytes(&trainer());
    let number = |name: &str, values: &[f64]| {
        let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        (name.to_owned(), Dtype::F64, vec![values.len()], bytes)
    };
    for (name, values, part) in [
        ("carried.bilateral_weight", &[0.5][..], "`bilateral_weight`"),
        ("carried.ssim_weight", &[0.5, 0.5], "carried.ssim_weight"),
    ] {
        let newer = rewritten(&bytes, FORMAT, |tensors| {
            tensors.retain(|(other, ..)| other != name);
            tensors.push(number(name, values));
        });
        let error = read(&newer).err().unwrap();
        assert!(error.contains(part) && !error.contains('\n'), "{error}");
    }
    let other = rewritten(&bytes, "irradia-checkpoint-3", |_| ());
    assert!(read(&other).err().is_some_and(|error| error.contains(FORMAT)));
}

#[test]
fn a_resumed_run_knows_how_much_of_its_recipe_it_has_skipped() {
    let mut trainer = trainer();
    assert_eq!(read(&to_bytes(&trainer)).unwrap().skipped, 0.0);
    trainer.skipped = 2400.5;
    assert_eq!(read(&to_bytes(&trainer)).unwrap().skipped, 2400.5);
}

#[test]
fn moments_follow_edited_splats() {
    let mut trainer = trainer();
    let state = trainer.engine.state_mut();
    let n = state.len();
    for i in 0..n {
        state.moments[0].means.set(1, i, i as f32 + 0.5);
        state.moments[1].sh.set(2, i, i as f32 + 0.25);
        state.statistics.set(0, i, i as f32);
    }
    let bytes = to_bytes(&trainer);
    let splats = splats_of(&bytes).unwrap();
    assert_eq!(splats, trainer.engine.state().splats);
    let same: Vec<Option<u32>> = (0..n as u32).map(Some).collect();
    // The order of the metadata in the header varies.
    let data = |bytes: &[u8]| bytes[8 + u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize..].to_vec();
    let edited = with_splats(&bytes, &splats, &same).unwrap();
    assert!(data(&edited) == data(&bytes), "an edit that changes nothing");

    // The last splat, a new one, the first.
    let edited = splats.gather(&[n as u32 - 1, 3, 0]);
    let sources = [Some(n as u32 - 1), None, Some(0)];
    let bytes = with_splats(&bytes, &edited, &sources).unwrap();
    let resumed = from_bytes(&bytes, dataset(), TrainOptions::default()).unwrap();
    let state = resumed.engine.state();
    assert_eq!((state.splats.means.clone(), resumed.clock.step), (edited.means, 7));
    let first = |c: usize| (0..3).map(|i| state.moments[0].means.get(c, i)).collect::<Vec<_>>();
    assert_eq!(first(1), [n as f32 - 0.5, 0.0, 0.5]);
    assert_eq!(state.moments[1].sh.get(2, 0), n as f32 - 0.75);
    assert_eq!(
        (state.statistics.get(0, 0), state.statistics.get(0, 1)),
        (n as f32 - 1.0, 0.0)
    );
    assert!(splats_of(&bytes[..bytes.len() - 9]).is_err() && splats_of(b"no checkpoint").is_err());
}
