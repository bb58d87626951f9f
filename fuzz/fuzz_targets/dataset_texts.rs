#![no_main]

use irradia_formats::parse;
use libfuzzer_sys::fuzz_target;

/// The smaller parsers of datasets; the first byte selects one.
const PARSERS: [fn(&[u8]); 12] = [
    |text| drop(parse::bundle(text)),
    |text| drop(parse::meshroom(text)),
    |text| drop(parse::metashape(text)),
    |text| drop(parse::nerfies_camera(text)),
    |text| drop(parse::nerfies_dataset(text)),
    |text| drop(parse::nvm(text)),
    |text| drop(parse::openmvg(text)),
    |text| drop(parse::opensfm(text)),
    |text| drop(parse::polycam(text)),
    |text| drop(parse::realitycapture_csv(text)),
    |text| drop(parse::realitycapture_xmp(text)),
    |text| drop(parse::record3d(text)),
];

fuzz_target!(|data: &[u8]| {
    if let Some((first, text)) = data.split_first() {
        PARSERS[usize::from(*first) % PARSERS.len()](text);
    }
});
