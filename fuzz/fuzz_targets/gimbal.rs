#![no_main]

use irradia_formats::parse;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    parse::gimbal(data);
});
