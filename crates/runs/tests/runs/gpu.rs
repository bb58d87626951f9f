//! Runs on a GPU, compared with the same runs on the CPU.

use super::*;
use irradia_compute::gpu::{Gpu, Wanted};
use irradia_compute::{Device, DeviceChoice};

fn has_gpu() -> bool {
    irradia_testkit::gpu_or_skip(|| Gpu::open(&Wanted::Any)).is_some()
}

fn begin_on_device(device: &str, folder: &Path, recipe: &str, steps: u64) -> Run {
    let request = TrainInput {
        device: device.to_owned(),
        recipe: recipe.to_owned(),
        ..input(folder, &format!("{recipe}-{device}"), steps)
    };
    Run::begin_on(request.check().expect("a request"), dataset()).expect("a run")
}

#[test]
fn a_run_on_the_gpu_ends_as_on_the_cpu() {
    if !has_gpu() {
        return;
    }
    let folder = folder();
    for recipe in ["fast", "classic", "mcmc", "curriculum"] {
        let psnr = ["cpu", "gpu"].map(|device| {
            let mut run = begin_on_device(device, folder.path(), recipe, 30);
            run.train(&mut []).expect("trains");
            let report = run.finish().expect("finishes").report;
            // The smoothness and coarse losses of `curriculum` are computed on the CPU, and the report says so.
            let told = report
                .warnings
                .iter()
                .any(|line| line.contains("read back from the GPU"));
            assert_eq!(told, device == "gpu" && recipe == "curriculum", "{:?}", report.warnings);
            assert_eq!(report.device.contains("GPU"), device == "gpu", "{}", report.device);
            report.psnr
        });
        // mcmc draws different random numbers on the GPU; 30 steps amplify the difference little.
        let most = if recipe == "mcmc" { 0.3 } else { 0.1 };
        assert!((psnr[0] - psnr[1]).abs() < most, "{recipe}: {psnr:?}");
    }
}

#[test]
fn a_hash_grid_on_the_gpu_ends_as_on_the_cpu() {
    if !has_gpu() {
        return;
    }
    let folder = folder();
    let psnr = ["cpu", "gpu"].map(|device| {
        let small = [
            "field.samples=4096",
            "field.sampler.side=32",
            "field.net.encoding.log2_table=12",
        ];
        let request = TrainInput {
            device: device.to_owned(),
            recipe: "hashgrid".to_owned(),
            set: small.map(str::to_owned).to_vec(),
            ..input(folder.path(), &format!("field-{device}"), 30)
        };
        let mut run = Run::begin_on(request.check().expect("a request"), dataset()).expect("a run");
        run.train(&mut []).expect("trains");
        run.finish().expect("finishes").report.psnr
    });
    assert!((psnr[0] - psnr[1]).abs() < 0.3, "{psnr:?}");
}

#[test]
fn a_run_moves_between_devices_and_names_its_own() {
    if !has_gpu() {
        return;
    }
    struct StopAt(u64, Vec<String>);
    impl Observer for StopAt {
        fn on_event(&mut self, event: &Event, trainer: &Trainer) -> Signal {
            if let Event::Decided { message } = event {
                self.1.push(message.clone());
            }
            if trainer.clock.step >= self.0 {
                Signal::Stop
            } else {
                Signal::Continue
            }
        }
    }
    let folder = folder();
    let mut run = begin_on_device("gpu", folder.path(), "classic", 20);
    let mut observer = StopAt(10, Vec::new());
    run.train(&mut [&mut observer]).expect("trains");
    assert!(
        observer.1.iter().any(|line| line.contains("trained on the GPU")),
        "{:?}",
        observer.1
    );
    assert!(!run.finish().expect("finishes").complete);
    let mut input = TrainInput::of_run(folder.path().join("classic-gpu")).expect("a run");
    assert_eq!(input.device, "gpu");
    input.device = "cpu".to_owned();
    let mut run = Run::resume_on(input.check().expect("a request"), dataset()).expect("resumes");
    assert_eq!(run.trainer().clock.step, 10);
    run.train(&mut []).expect("trains");
    let moved = run.finish().expect("finishes").report.psnr;
    let mut whole = begin_on_device("cpu", folder.path(), "classic", 20);
    whole.train(&mut []).expect("trains");
    let expected = whole.finish().expect("finishes").report.psnr;
    assert!((moved - expected).abs() < 0.1, "{moved} {expected}");
}

#[test]
fn a_lost_gpu_ends_the_run_with_a_line_and_leaves_its_checkpoint() {
    if !has_gpu() {
        return;
    }
    struct LoseAt(u64);
    impl Observer for LoseAt {
        fn on_event(&mut self, _: &Event, trainer: &Trainer) -> Signal {
            if trainer.clock.step == self.0 {
                let Device::Gpu(gpu) = &trainer.options.device else {
                    panic!("a run on the GPU")
                };
                gpu.fail("it was unplugged");
            }
            if trainer.clock.step == 5 {
                Signal::Save
            } else {
                Signal::Continue
            }
        }
    }
    let folder = folder();
    let mut run = begin_on_device("gpu", folder.path(), "classic", 20);
    let error = run
        .train(&mut [&mut LoseAt(8)])
        .expect_err("the GPU is lost")
        .to_string();
    assert!(error.contains("it was unplugged") && !error.contains('\n'), "{error}");
    drop(run);
    let input = TrainInput::of_run(folder.path().join("classic-gpu")).expect("a run");
    let input = TrainInput {
        device: "cpu".to_owned(),
        ..input
    };
    let mut run = Run::resume_on(input.check().expect("a request"), dataset()).expect("resumes");
    assert_eq!(run.trainer().clock.step, 5);
    run.train(&mut []).expect("trains");
    assert!(run.finish().expect("finishes").report.psnr > 5.0);
}

#[test]
fn a_gpu_that_is_not_there_is_a_mistake_of_the_request() {
    let request = TrainInput {
        device: "no such card".to_owned(),
        ..input(folder().path(), "run", 5)
    };
    let error = Run::begin_on(request.check().expect("a request"), dataset())
        .err()
        .expect("no such GPU");
    let line = error.to_string();
    assert!(
        line.contains("device no such card") && line.contains("irradia devices"),
        "{line}"
    );
    assert!(Device::open(&DeviceChoice::Auto).is_ok(), "auto never fails");
}

#[test]
fn pictures_of_the_gpu_are_those_of_the_cpu() {
    if !has_gpu() {
        return;
    }
    let folder = folder();
    let mut run = begin(folder.path(), "run", 20);
    run.train(&mut []).expect("trains");
    run.finish().expect("finishes");
    let scene = Scene::read(folder.path().join("run")).expect("a scene");
    let device = Device::open(&DeviceChoice::Gpu).expect("a GPU");
    let mut painter = irradia_runs::train::painter::Painter::new(&scene.model, &device).expect("kernels");
    for camera in scene.orbit(3, Some((80, 60))) {
        let got = painter.render(&camera, &scene.options).expect("a frame").color;
        let expected = scene.render(&camera).color;
        assert!(irradia_measure::psnr(&got, &expected) > 60.0);
    }
}
