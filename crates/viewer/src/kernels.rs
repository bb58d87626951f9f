//! The program's own compute shaders, for pages that draw with WebGPU.

use irradia_splat::shaders::frame_shaders;
use serde_json::json;
use std::sync::LazyLock;

/// `{"parts": [text, ..], "kernels": {name: [number of part, ..], ..}}`: a kernel is the concatenation of its parts; a part that
/// several kernels share is stored once.
pub(crate) fn kernels() -> &'static str {
    static TEXT: LazyLock<String> = LazyLock::new(|| {
        let mut parts: Vec<&str> = Vec::new();
        let mut number = |part: &'static str| {
            let known = parts.iter().position(|known| *known == part);
            known.unwrap_or_else(|| {
                parts.push(part);
                parts.len() - 1
            })
        };
        let kernels: serde_json::Map<_, _> = frame_shaders()
            .map(|shader| {
                let numbers: Vec<usize> = shader.parts.iter().map(|part| number(part)).collect();
                (shader.name.to_owned(), json!(numbers))
            })
            .collect();
        json!({ "parts": parts, "kernels": kernels }).to_string()
    });
    &TEXT
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::page::file;

    /// Number of arrays that the page binds to a kernel: the elements of the list behind `.name, ` or `(name, `.
    fn bound(name: &str) -> usize {
        let scripts = ["device", "frame", "sort", "webgpu"].map(|script| {
            let (_, text) = file(&format!("js/local/{script}.js")).expect("a module of the page");
            text
        });
        let calls = ['.', '('].map(|before| format!("{before}{name}, ["));
        let list = scripts
            .iter()
            .flat_map(|text| calls.iter().map(move |call| text.split_once(call)));
        let (_, list) = list.flatten().next().unwrap_or_else(|| panic!("the page runs {name}"));
        let (mut depth, mut commas) = (0, 0);
        for letter in list.chars() {
            match letter {
                '[' => depth += 1,
                ']' if depth == 0 => break,
                ']' => depth -= 1,
                ',' if depth == 0 => commas += 1,
                _ => {}
            }
        }
        commas + 1
    }

    #[test]
    fn the_page_binds_what_kernels_have() {
        for shader in frame_shaders() {
            let bindings = shader.source().matches("@binding(").count();
            assert_eq!(bound(shader.name), bindings, "{}", shader.name);
        }
    }

    #[test]
    fn shaders_of_the_page_are_valid() {
        for name in ["shaders/unpack.wgsl", "shaders/present.wgsl"] {
            irradia_testkit::validate_shader(name, file(name).expect("a shader").1);
        }
    }

    #[test]
    fn parts_make_the_kernels_again() {
        let value: serde_json::Value = serde_json::from_str(kernels()).expect("JSON");
        let shaders: Vec<_> = frame_shaders().collect();
        assert_eq!(shaders.len(), 13);
        for shader in shaders {
            let numbers = value["kernels"][shader.name].as_array().expect("numbers");
            let parts = numbers.iter().map(|number| {
                let number = number.as_u64().expect("a number") as usize;
                value["parts"][number].as_str().expect("text")
            });
            assert_eq!(parts.collect::<String>(), shader.source(), "{}", shader.name);
        }
    }
}
