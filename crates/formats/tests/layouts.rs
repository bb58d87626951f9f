//! One synthetic capture, written in every layout by conversions of the tests' own and read back: cameras and rays must equal COLMAP's.

use glam::{DMat3, DQuat, DVec3, Vec2};
use image::{GrayImage, Luma, Rgb, RgbImage};
use irradia_formats::{DatasetFormat, DatasetOptions, read_dataset};
use irradia_scene::{Dataset, Rng, View};
use std::fmt::Write;
use std::fs;
use std::path::Path;
use tempfile::TempDir;

const WIDTH: f64 = 64.0;
const HEIGHT: f64 = 48.0;
const COUNT: usize = 5;
/// Tolerance of rays and centres: results are `f32`, and files have 12 digits.
const TOLERANCE: f32 = 1e-6;

/// The capture: camera-from-world, as COLMAP has it.
struct Truth {
    rotations: Vec<DQuat>,
    translations: Vec<DVec3>,
    focal: f64,
    /// Offset of the principal point from the centre, pixels.
    offset: [f64; 2],
    k: [f64; 3],
    p: [f64; 2],
}

/// What a layout can express.
#[derive(Clone, Copy, Default)]
struct Lens {
    offset: [f64; 2],
    k: [f64; 3],
    p: [f64; 2],
}

impl Truth {
    fn new(lens: Lens) -> Self {
        let mut rng = Rng::new(7, 1);
        let mut random = || DVec3::from_array([0; 3].map(|_| f64::from(rng.range(-1.0, 1.0))));
        Self {
            rotations: (0..COUNT).map(|_| DQuat::from_scaled_axis(2.0 * random())).collect(),
            translations: (0..COUNT).map(|_| 2.0 * random()).collect(),
            focal: 70.25,
            offset: lens.offset,
            k: lens.k,
            p: lens.p,
        }
    }

    /// Rows: right, down, forward.
    fn axes(&self, i: usize) -> [DVec3; 3] {
        let m = DMat3::from_quat(self.rotations[i]).transpose();
        [m.x_axis, m.y_axis, m.z_axis]
    }

    fn center(&self, i: usize) -> DVec3 {
        -(self.rotations[i].inverse() * self.translations[i])
    }

    /// World-from-camera with OpenGL axes, 3 x 4 row by row.
    fn opengl(&self, i: usize) -> [[f64; 4]; 3] {
        let [x, y, z] = self.axes(i);
        let c = self.center(i);
        [0, 1, 2].map(|row| [x[row], -y[row], -z[row], c[row]])
    }
}

fn name(i: usize) -> String {
    format!("shot {i}.png")
}

fn folder(images: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join(images)).unwrap();
    for i in 0..COUNT {
        let picture = RgbImage::from_pixel(WIDTH as u32, HEIGHT as u32, Rgb([i as u8, 2, 3]));
        picture.save(folder.path().join(images).join(name(i))).unwrap();
    }
    folder
}

fn read(path: &Path, format: DatasetFormat) -> Dataset {
    assert_eq!(DatasetFormat::recognise(path), Some(format), "not recognised");
    read_dataset(path, &DatasetOptions::default()).unwrap()
}

fn colmap(truth: &Truth) -> (TempDir, Dataset) {
    let folder = folder("images");
    let sparse = folder.path().join("sparse/0");
    fs::create_dir_all(&sparse).unwrap();
    let (f, [dx, dy], [k1, k2, k3], [p1, p2]) = (truth.focal, truth.offset, truth.k, truth.p);
    let (cx, cy) = (0.5 * WIDTH + dx, 0.5 * HEIGHT + dy);
    let camera = format!("1 FULL_OPENCV 64 48 {f} {f} {cx} {cy} {k1} {k2} {p1} {p2} {k3} 0 0 0\n");
    fs::write(sparse.join("cameras.txt"), camera).unwrap();
    let mut images = String::new();
    for i in 0..COUNT {
        let (q, t) = (truth.rotations[i], truth.translations[i]);
        let (w, x, y, z) = (q.w, q.x, q.y, q.z);
        writeln!(images, "{i} {w} {x} {y} {z} {} {} {} 1 {}\n", t.x, t.y, t.z, name(i)).unwrap();
    }
    fs::write(sparse.join("images.txt"), images).unwrap();
    let dataset = read(folder.path(), DatasetFormat::Colmap);
    (folder, dataset)
}

#[track_caller]
fn assert_same(got: &Dataset, truth: &Truth) {
    let (_folder, want) = colmap(truth);
    assert_eq!(got.views.len(), COUNT, "{:?}", got.warnings);
    for (got, want) in got.views.iter().zip(&want.views) {
        assert!(
            got.name.ends_with(want.name.trim_start_matches("images/")),
            "{} {}",
            got.name,
            want.name
        );
        let (a, b) = (&got.camera, &want.camera);
        assert_eq!(
            (a.intrinsics.width, a.intrinsics.height),
            (b.intrinsics.width, b.intrinsics.height)
        );
        let moved = (a.pose.position - b.pose.position).length();
        assert!(
            moved < TOLERANCE * (1.0 + b.pose.position.length()),
            "{}: centre is off by {moved}",
            got.name
        );
        for pixel in [Vec2::new(0.5, 0.5), Vec2::new(60.0, 3.0), Vec2::new(31.0, 44.0)] {
            let turned = a.ray(pixel).1.distance(b.ray(pixel).1);
            assert!(
                turned < TOLERANCE,
                "{}: the ray of {pixel} is off by {turned}",
                got.name
            );
        }
        assert_eq!(got.photo.load().unwrap().data, want.photo.load().unwrap().data);
    }
}

const BROWN: Lens = Lens {
    offset: [1.5, -0.75],
    k: [-0.11, 0.05, -0.01],
    p: [0.002, -0.001],
};

#[test]
fn opensfm() {
    for lens in [Lens::default(), BROWN] {
        let truth = Truth::new(lens);
        let folder = folder("images");
        let shots: Vec<String> = (0..COUNT)
            .map(|i| {
                let (r, t) = (
                    truth.rotations[i].to_scaled_axis().to_array(),
                    truth.translations[i].to_array(),
                );
                format!(
                    r#""{}": {{"rotation": {r:?}, "translation": {t:?}, "camera": "c", "gps_dop": 15}}"#,
                    name(i)
                )
            })
            .collect();
        let f = truth.focal / WIDTH;
        let [dx, dy] = truth.offset.map(|v| v / WIDTH);
        let ([k1, k2, k3], [p1, p2]) = (truth.k, truth.p);
        let text = format!(
            r#"[{{"cameras": {{}}, "shots": {{}}}}, {{"cameras": {{"c": {{"projection_type": "brown", "width": 64, "height": 48,
            "focal_x": {f}, "focal_y": {f}, "c_x": {dx}, "c_y": {dy}, "k1": {k1}, "k2": {k2}, "k3": {k3}, "p1": {p1}, "p2": {p2}}}}},
            "shots": {{{}}}, "points": {{"7": {{"color": [255.0, 0, 1], "coordinates": [1, 2, 3]}}}}}}]"#,
            shots.join(",")
        );
        fs::create_dir(folder.path().join("opensfm")).unwrap();
        // With a byte order mark, and a number of Python's that is not JSON.
        let text = format!("\u{feff}{}", text.replacen('{', r#"{"gps_dop": NaN, "#, 1));
        fs::write(folder.path().join("opensfm/reconstruction.json"), text).unwrap();
        let dataset = read(folder.path(), DatasetFormat::Opensfm);
        assert_same(&dataset, &truth);
        assert_eq!(dataset.points.as_ref().unwrap().colors, [[255, 0, 1]]);
        assert!(dataset.warnings[0].contains("largest of 2"), "{:?}", dataset.warnings);
    }
}

#[test]
fn openmvg() {
    for (lens, is_nested) in [(Lens::default(), false), (BROWN, false), (BROWN, true)] {
        let truth = Truth::new(lens);
        let folder = folder("images/left");
        let f = truth.focal;
        let ([k1, k2, k3], [p1, p2], [dx, dy]) = (truth.k, truth.p, truth.offset);
        let size = r#""width": 64, "height": 48"#;
        let pinhole = format!(
            r#""focal_length": {f}, "principal_point": [{}, {}]"#,
            32.0 + dx,
            24.0 + dy
        );
        let shared = if is_nested {
            format!(r#""value0": {{"value0": {{{size}}}, {pinhole}}}"#)
        } else {
            format!("{size}, {pinhole}")
        };
        let [mut views, mut poses] = [Vec::new(), Vec::new()];
        // The last view has no pose.
        for i in 0..=COUNT {
            views.push(format!(
                r#"{{"key": {i}, "value": {{"polymorphic_id": 1073741824, "ptr_wrapper": {{"id": 1, "data": {{"local_path": "/left",
                "filename": "{}", "width": 64, "height": 48, "id_view": {i}, "id_intrinsic": 7, "id_pose": {i}}}}}}}}}"#,
                name(i)
            ));
        }
        for i in 0..COUNT {
            let rows = truth.axes(i).map(|axis| axis.to_array());
            let center = truth.center(i).to_array();
            poses.push(format!(
                r#"{{"key": {i}, "value": {{"rotation": {rows:?}, "center": {center:?}}}}}"#
            ));
        }
        let text = format!(
            r#"{{"sfm_data_version": "0.3", "root_path": "/absent", "views": [{}], "intrinsics": [{{"key": 7, "value": {{
            "polymorphic_name": "pinhole_brown_t2", "ptr_wrapper": {{"data": {{{shared}, "disto_t2": [{k1}, {k2}, {k3}, {p1}, {p2}]}}}}}}}}],
            "extrinsics": [{}], "structure": [{{"key": 3, "value": {{"X": [1, 2, 3], "observations": [{{"key": 2, "value": {{"id_feat": 0,
            "x": [1, 2]}}}}]}}}}], "control_points": []}}"#,
            views.join(","),
            poses.join(",")
        );
        fs::write(folder.path().join("sfm_data.json"), text).unwrap();
        let dataset = read(folder.path(), DatasetFormat::Openmvg);
        assert!(
            dataset.warnings[0].starts_with("1 photographs"),
            "{:?}",
            dataset.warnings
        );
        assert_eq!(dataset.views[2].points_seen, [0]);
        assert_same(&dataset, &truth);
        let file = folder.path().join("sfm_data.json");
        assert_eq!(DatasetFormat::recognise(&file), Some(DatasetFormat::Openmvg));
    }
}

#[test]
fn meshroom() {
    for version in [[1, 0, 0], [1, 2, 3], [1, 2, 8]] {
        let truth = Truth::new(BROWN);
        let folder = folder("");
        let texts = |numbers: &[f64]| {
            let quoted: Vec<String> = numbers.iter().map(|number| format!("\"{number}\"")).collect();
            quoted.join(",")
        };
        let ([k1, k2, k3], [p1, p2], [dx, dy]) = (truth.k, truth.p, truth.offset);
        let distortion = texts(&[k1, k2, k3, p1, p2]);
        let intrinsics = match version {
            [1, 0, 0] => format!(
                r#""type": "brown", "pxFocalLength": "{}", "principalPoint": [{}]"#,
                truth.focal,
                texts(&[32.0 + dx, 24.0 + dy])
            ),
            _ => format!(
                r#"{}, "sensorWidth": "16", "focalLength": "{}", "pixelRatio": "1", "principalPoint": [{}]"#,
                if version == [1, 2, 3] {
                    r#""type": "brown""#
                } else {
                    r#""type": "pinhole", "distortionType": "brown""#
                },
                truth.focal / WIDTH * 16.0,
                texts(&[dx, dy])
            ),
        };
        let [mut views, mut poses] = [Vec::new(), Vec::new()];
        for i in 0..COUNT {
            views.push(format!(
                r#"{{"viewId": "{}", "poseId": "{i}", "intrinsicId": "5", "path": "C:/absent/{}", "metadata": {{"a": "b"}}}}"#,
                i + 20,
                name(i)
            ));
            let [x, y, z] = truth.axes(i);
            let columns = [0, 1, 2].map(|c| [x[c], y[c], z[c]]).concat();
            poses.push(format!(
                r#"{{"poseId": "{i}", "pose": {{"transform": {{"rotation": [{}], "center": [{}]}}, "locked": "0"}}}}"#,
                texts(&columns),
                texts(&truth.center(i).to_array())
            ));
        }
        let of_rig =
            r#"{"viewId": "9", "poseId": "0", "rigId": "3", "subPoseId": "1", "intrinsicId": "5", "path": "rig.jpg"}"#;
        let text = format!(
            r#"{{"version": [{}], "views": [{}, {of_rig}], "intrinsics": [{{"intrinsicId": "5", "width": "64", "height": "48", {intrinsics},
            "distortionParams": [{distortion}], "undistortionParams": ""}}], "poses": [{}], "structure": [{{"landmarkId": "1",
            "descType": "sift", "color": ["255", "0", "1"], "X": ["1", "2", "3"], "observations": [{{"observationId": "22"}}]}}]}}"#,
            texts(&version.map(f64::from)),
            views.join(","),
            poses.join(",")
        );
        fs::write(folder.path().join("cameraInit.sfm"), r#"{"views": []}"#).unwrap();
        fs::write(folder.path().join("cameras.sfm"), text).unwrap();
        let dataset = read(folder.path(), DatasetFormat::Meshroom);
        assert!(dataset.warnings[0].contains("rig"), "{:?}", dataset.warnings);
        assert_eq!(dataset.views[2].points_seen, [0]);
        assert_eq!(dataset.points.as_ref().unwrap().colors, [[255, 0, 1]]);
        assert_same(&dataset, &truth);
    }
}

#[test]
fn bundler_and_visualsfm() {
    for radial in [0.0, 0.04] {
        let lens = Lens {
            k: [-radial, 3.0 * radial * radial, -12.0 * radial * radial * radial],
            ..Lens::default()
        };
        let truth = Truth::new(Lens {
            k: [lens.k[0], lens.k[1], 0.0],
            ..lens
        });
        let root = folder("images");
        let mut bundle = format!("# Bundle file v0.3\n{} 1\n", COUNT + 1);
        for i in 0..COUNT {
            let [right, down, forward] = truth.axes(i);
            let t = truth.translations[i];
            writeln!(bundle, "{} {} {}", truth.focal, truth.k[0], truth.k[1]).unwrap();
            for row in [right, -down, -forward, DVec3::new(t.x, -t.y, -t.z)] {
                writeln!(bundle, "{} {} {}", row.x, row.y, row.z).unwrap();
            }
        }
        bundle += "0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n1 2 3\n255 0 1\n2 0 17 1.5 -2.5 3 18 0 0\n";
        fs::write(root.path().join("bundle.out"), bundle).unwrap();
        // Names with spaces are not possible in a list.
        for i in 0..COUNT {
            fs::rename(
                root.path().join("images").join(name(i)),
                root.path().join(format!("images/{i}.png")),
            )
            .unwrap();
        }
        let list: String = (0..=COUNT).map(|i| format!("./images/{i}.png 0 70.25\n")).collect();
        fs::write(root.path().join("list.txt"), list).unwrap();
        let dataset = read(root.path(), DatasetFormat::Bundler);
        assert_eq!(dataset.views[3].points_seen, [0]);
        for view in 0..COUNT {
            assert_eq!(dataset.views[view].name, format!("images/{view}.png"));
        }
        let mut renamed = dataset;
        for (i, view) in renamed.views.iter_mut().enumerate() {
            view.name = name(i);
        }
        assert_same(&renamed, &truth);

        let truth = Truth::new(lens);
        let root = folder("");
        let mut nvm = format!("NVM_V3 \n\n{COUNT}\n");
        for i in 0..COUNT {
            let (q, c) = (truth.rotations[i], truth.center(i));
            writeln!(
                nvm,
                "{}\t{} {} {} {} {} {} {} {} {radial} 0",
                name(i),
                truth.focal,
                q.w,
                q.x,
                q.y,
                q.z,
                c.x,
                c.y,
                c.z
            )
            .unwrap();
        }
        nvm += "\n1\n1 2 3 255 0 1 2 0 17 1.5 -2.5 3 18 0 0\n\n\n0\n\n#the last part of NVM file\n0\n";
        fs::write(root.path().join("scene.nvm"), nvm).unwrap();
        let dataset = read(root.path(), DatasetFormat::Nvm);
        assert_eq!(
            (dataset.views[0].points_seen.len(), dataset.views[1].points_seen.len()),
            (1, 0)
        );
        assert_same(&dataset, &truth);
    }
}

#[test]
fn metashape() {
    for lens in [Lens::default(), BROWN] {
        let truth = Truth::new(lens);
        let folder = folder("images");
        // The chunk is twice as large as the world, turned and moved.
        let turn = DMat3::from_rotation_z(0.3);
        let offset = DVec3::new(3.0, -1.0, 2.0);
        let mut cameras = String::new();
        for i in 0..COUNT {
            let [x, y, z] = truth.axes(i).map(|axis| turn.transpose() * axis);
            let c = turn.transpose() * (truth.center(i) - offset) * 2.0;
            let rows = [0, 1, 2]
                .map(|r| format!("{} {} {} {}", x[r], y[r], z[r], c[r]))
                .join(" ");
            write!(
                cameras,
                r#"<camera id="{i}" sensor_id="0" label="shot {i}"><transform>{rows} 0 0 0 1</transform></camera>"#
            )
            .unwrap();
        }
        let t = turn.transpose().to_cols_array().map(|v| v.to_string()).join(" ");
        let ([k1, k2, k3], [p1, p2], [dx, dy], f) = (truth.k, truth.p, truth.offset, truth.focal);
        let text = format!(
            r#"<?xml version="1.0"?><document version="2.0.0"><chunk label="Chunk 1"><sensors><sensor id="0" type="frame">
            <resolution width="64" height="48"/><calibration type="frame" class="initial"><f>1</f></calibration>
            <calibration type="frame" class="adjusted"><resolution width="64" height="48"/><f>{f}</f><cx>{dx}</cx><cy>{dy}</cy>
            <k1>{k1}</k1><k2>{k2}</k2><k3>{k3}</k3><p1>{p2}</p1><p2>{p1}</p2></calibration></sensor></sensors>
            <cameras><group>{cameras}</group><camera id="9" sensor_id="0" label="not aligned"/>
            <camera id="10" sensor_id="0" label="disabled" enabled="false"><transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>
            </cameras>
            <transform><rotation>{t}</rotation><translation>3 -1 2</translation><scale>0.5</scale></transform></chunk></document>"#
        );
        fs::write(folder.path().join("cameras.xml"), text).unwrap();
        let dataset = read(folder.path(), DatasetFormat::Metashape);
        let [disabled, unaligned] = [&dataset.warnings[0], &dataset.warnings[1]];
        assert!(disabled.starts_with("1 photographs are disabled"), "{disabled}");
        assert!(unaligned.starts_with("1 photographs are not aligned"), "{unaligned}");
        assert_same(&dataset, &truth);
    }
}

#[test]
fn masks_beside_are_found_in_any_layout_and_a_calibration_alone_is_no_pose() {
    let folder = folder("images");
    let images = folder.path().join("images");
    let xmp = |pose: &str| {
        format!(
            r#"<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description xcr:Version="3" xcr:FocalLength35mm="30">{pose}</rdf:Description></rdf:RDF></x:xmpmeta>"#
        )
    };
    for i in 0..COUNT {
        fs::write(images.join(format!("shot {i}.xmp")), xmp("")).unwrap();
    }
    assert_eq!(DatasetFormat::recognise(folder.path()), None);
    fs::create_dir(folder.path().join("masks")).unwrap();
    for i in 1..COUNT {
        let pose = format!("<xcr:Rotation>1 0 0 0 1 0 0 0 1</xcr:Rotation><xcr:Position>{i} 0 0</xcr:Position>");
        fs::write(images.join(format!("shot {i}.xmp")), xmp(&pose)).unwrap();
        // 0 and 1, as some programs write them.
        let mask = GrayImage::from_fn(WIDTH as u32, HEIGHT as u32, |x, _| Luma([u8::from(x < 20)]));
        mask.save(folder.path().join("masks").join(name(i))).unwrap();
    }
    let dataset = read(folder.path(), DatasetFormat::RealityCapture);
    assert_eq!(dataset.views.len(), COUNT - 1);
    for view in &dataset.views {
        let mask = view.photo.load().unwrap().mask.expect("a mask");
        let shown = mask.iter().filter(|value| **value > 0).count();
        assert_eq!(shown, 20 * HEIGHT as usize);
    }
}

#[test]
fn realitycapture() {
    for lens in [Lens::default(), BROWN] {
        let truth = Truth::new(lens);
        let ([k1, k2, k3], [p1, p2]) = (truth.k, truth.p);
        let f = truth.focal / WIDTH * 36.0;
        let table = folder("");
        let mut rows = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n".to_owned();
        let [px, py] = truth.offset.map(|v| v / WIDTH);
        for i in 0..COUNT {
            let [x, y, z] = truth.axes(i);
            // m = Rz(-heading) Rx(pitch) Ry(roll), columns right, up, backward.
            let (right, up, back) = (x, -y, -z);
            let pitch = up.z.asin();
            let (roll, heading) = ((-right.z).atan2(back.z), up.x.atan2(up.y));
            let c = truth.center(i);
            let [h, p, r] = [heading, pitch, roll].map(f64::to_degrees);
            writeln!(
                rows,
                "{},{},{},{},{h},{p},{r},{f},{px},{py},{k1},{k2},{k3},0,{p2},{p1}",
                name(i),
                c.x,
                c.y,
                c.z
            )
            .unwrap();
        }
        fs::write(table.path().join("cameras.csv"), rows).unwrap();
        assert_same(&read(table.path(), DatasetFormat::RealityCapture), &truth);

        let xmp_folder = folder("images");
        let [u, v] = truth.offset.map(|v| v / WIDTH);
        for i in 0..COUNT {
            let r = truth
                .axes(i)
                .map(|axis| format!("{} {} {}", axis.x, axis.y, axis.z))
                .join(" ");
            let c = truth.center(i);
            let text = format!(
                r#"<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description xcr:Version="3" xcr:DistortionModel="brown3"
                xcr:FocalLength35mm="{f}" xcr:PrincipalPointU="{u}" xcr:PrincipalPointV="{v}"><xcr:Rotation>{r}</xcr:Rotation>
                <xcr:Position>{} {} {}</xcr:Position><xcr:DistortionCoeficients>{k1} {k2} {k3} 0 {p2} {p1}</xcr:DistortionCoeficients>
                </rdf:Description></rdf:RDF></x:xmpmeta>"#,
                c.x, c.y, c.z
            );
            fs::write(xmp_folder.path().join("images").join(format!("shot {i}.xmp")), text).unwrap();
        }
        assert_same(&read(xmp_folder.path(), DatasetFormat::RealityCapture), &truth);
    }
}

#[test]
fn phones() {
    let truth = Truth::new(Lens {
        offset: BROWN.offset,
        ..Lens::default()
    });
    let (f, [dx, dy]) = (truth.focal, truth.offset);
    let (cx, cy) = (0.5 * WIDTH + dx, 0.5 * HEIGHT + dy);
    let polycam = folder("keyframes/corrected_images");
    let cameras = polycam.path().join("keyframes/corrected_cameras");
    fs::create_dir_all(&cameras).unwrap();
    for i in 0..COUNT {
        let m = truth.opengl(i);
        let cells = [0, 1, 2]
            .map(|r| [0, 1, 2, 3].map(|c| format!(r#""t_{r}{c}": {},"#, m[r][c])).concat())
            .concat();
        let text = format!(
            r#"{{{cells} "fx": {f}, "fy": {f}, "cx": {cx}, "cy": {cy}, "width": 64, "height": 48, "blur_score": 9}}"#
        );
        fs::write(cameras.join(format!("shot {i}.json")), text).unwrap();
    }
    let depths = polycam.path().join("keyframes/depth");
    fs::create_dir_all(&depths).unwrap();
    GrayImage::from_pixel(8, 6, Luma([9]))
        .save(depths.join("shot 1.png"))
        .unwrap();
    let found = read(polycam.path(), DatasetFormat::Polycam);
    assert_same(&found, &truth);
    let grid = |view: &View| view.depth_map.as_ref().map(|map| map.load().unwrap());
    let grids: Vec<_> = found.views.iter().map(grid).collect();
    assert!(grids.iter().flatten().count() == 1 && grids[1].as_ref().unwrap().values[0] == 9.0);

    let record = folder("rgb");
    let mut poses = Vec::new();
    for i in 0..COUNT {
        fs::rename(
            record.path().join("rgb").join(name(i)),
            record.path().join(format!("rgb/{i}.png")),
        )
        .unwrap();
        let m = truth.opengl(i).map(|row| DVec3::new(row[0], row[1], row[2]));
        let q = DQuat::from_mat3(&DMat3::from_cols(m[0], m[1], m[2]).transpose());
        let c = truth.center(i);
        poses.push([q.x, q.y, q.z, q.w, c.x, c.y, c.z]);
    }
    let text =
        format!(r#"{{"w": 64, "h": 48, "fps": 60, "K": [{f}, 0, 0, 0, {f}, 0, {cx}, {cy}, 1], "poses": {poses:?}}}"#);
    fs::write(record.path().join("metadata.json"), text).unwrap();
    let mut dataset = read(record.path(), DatasetFormat::Record3d);
    for (i, view) in dataset.views.iter_mut().enumerate() {
        view.name = name(i);
    }
    assert_same(&dataset, &truth);
}

#[test]
fn nerfies() {
    let truth = Truth::new(BROWN);
    let folder = folder("rgb/1x");
    fs::create_dir(folder.path().join("camera")).unwrap();
    let (cx, cy) = (0.5 * WIDTH + truth.offset[0], 0.5 * HEIGHT + truth.offset[1]);
    for i in 0..COUNT {
        let text = format!(
            r#"{{"orientation": {:?}, "position": {:?}, "focal_length": {}, "principal_point": [{cx}, {cy}], "skew": 0.0,
            "pixel_aspect_ratio": 1.0, "radial_distortion": {:?}, "tangential": {:?}, "image_size": [64, 48]}}"#,
            truth.axes(i).map(|axis| axis.to_array()),
            truth.center(i).to_array(),
            truth.focal,
            truth.k,
            truth.p
        );
        fs::write(folder.path().join(format!("camera/shot {i}.json")), text).unwrap();
    }
    let ids: Vec<String> = (0..COUNT).map(|i| format!("shot {i}")).collect();
    let lists = format!(
        r#"{{"count": 5, "ids": {ids:?}, "train_ids": {:?}, "val_ids": {:?}}}"#,
        &ids[1..],
        &ids[..1]
    );
    fs::write(folder.path().join("dataset.json"), lists).unwrap();
    let metadata = r#"{"shot 2": {"warp_id": 4, "appearance_id": 4, "camera_id": 0}}"#;
    fs::write(folder.path().join("metadata.json"), metadata).unwrap();
    let dataset = read(folder.path(), DatasetFormat::Nerfies);
    assert_eq!(
        (&dataset.test, dataset.train.len(), dataset.views[2].time),
        (&vec![0], 4, Some(4.0))
    );
    assert_same(&dataset, &truth);
}

#[test]
fn colmap_models_may_begin_with_any_number_and_names_with_folders_of_other_computers() {
    let truth = Truth::new(Lens::default());
    let (root, expected) = colmap(&truth);
    let root = root.path();
    let sparse = root.join("sparse/0");
    fs::rename(&sparse, root.join("sparse/3")).unwrap();
    let sparse = root.join("sparse/3");
    let images = fs::read_to_string(sparse.join("images.txt")).unwrap();
    for prefix in ["images/", "C:\\Users\\me\\images\\", "/home/me/scene/"] {
        fs::write(
            sparse.join("images.txt"),
            images.replace("shot ", &format!("{prefix}shot ")),
        )
        .unwrap();
        let dataset = read(root, DatasetFormat::Colmap);
        assert_same(&dataset, &truth);
        assert_eq!(dataset.views[0].name, expected.views[0].name, "{prefix}");
    }
}

#[test]
fn photographs_in_another_folder_and_the_largest_of_several_models() {
    let truth = Truth::new(Lens::default());
    let root = folder("elsewhere/in/a folder");
    for (model, count) in [(0, 2), (1, COUNT), (2, 3)] {
        let sparse = root.path().join(format!("sparse/{model}"));
        fs::create_dir_all(&sparse).unwrap();
        fs::write(sparse.join("cameras.txt"), "1 SIMPLE_PINHOLE 64 48 70.25 32 24\n").unwrap();
        let mut images = String::new();
        for i in 0..count {
            let (q, t) = (truth.rotations[i], truth.translations[i]);
            let (w, x, y, z) = (q.w, q.x, q.y, q.z);
            writeln!(images, "{i} {w} {x} {y} {z} {} {} {} 1 a/{}\n", t.x, t.y, t.z, name(i)).unwrap();
        }
        fs::write(sparse.join("images.txt"), images).unwrap();
    }
    let options = |folder: &str| DatasetOptions {
        images: Some(root.path().join(folder)),
        ..DatasetOptions::default()
    };
    let dataset = read_dataset(root.path(), &options("elsewhere/in/a folder")).unwrap();
    assert_same(&dataset, &truth);
    assert!(
        dataset.warnings[0].contains("sparse/1 is used, with 5 of their 10"),
        "{:?}",
        dataset.warnings
    );
    let above = read_dataset(root.path(), &options("elsewhere")).unwrap();
    assert_same(&above, &truth);
    let error = read_dataset(root.path(), &options("sparse")).err().unwrap().to_string();
    assert!(error.contains("none of the dataset's photographs"), "{error}");
}

#[test]
fn sixteen_bits_are_read_as_eight() {
    let root = folder("images");
    for i in 0..COUNT {
        let path = root.path().join("images").join(name(i));
        let deep: image::ImageBuffer<Rgb<u16>, Vec<u16>> =
            image::ImageBuffer::from_pixel(WIDTH as u32, HEIGHT as u32, Rgb([257 * 200, 257 * 7 + 100, 65535]));
        deep.save(path).unwrap();
    }
    let frames: Vec<String> = (0..COUNT)
        .map(|i| {
            let m = Truth::new(Lens::default()).opengl(i);
            format!(r#"{{"file_path": "images/{}", "transform_matrix": {m:?}}}"#, name(i))
        })
        .collect();
    let text = format!(r#"{{"fl_x": 70, "frames": [{}]}}"#, frames.join(","));
    fs::write(root.path().join("transforms.json"), text).unwrap();
    let photo = read(root.path(), DatasetFormat::Nerfstudio).views[0]
        .photo
        .load()
        .unwrap();
    assert_eq!((photo.channels, &photo.data[..3]), (3, &[200u8, 7, 255][..]));
}
