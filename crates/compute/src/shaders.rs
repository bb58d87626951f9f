//! The text of the compute shaders, for the feature `gpu` and for others that run WGSL, such as browsers.

/// `group_index`: the number of a workgroup, for kernels whose workgroups are dispatched in rows.
pub const GRID: &str = include_str!("gpu/shaders/grid.wgsl");
/// `adam`: one step.
pub const ADAM: &str = include_str!("gpu/shaders/adam.wgsl");
/// `basis`: real spherical harmonics of a direction, and `basis_vjp`.
pub const HARMONICS: &str = include_str!("gpu/shaders/harmonics.wgsl");
const GROUP_SCAN: &str = include_str!("gpu/shaders/scan_group.wgsl");

/// The source of a kernel. Its entry point is `main`, its bindings are those of group 0, in order, all of them used.
#[derive(Clone, Copy, Debug)]
pub struct Shader {
    /// For messages and tests.
    pub name: &'static str,
    /// WGSL: shared functions first.
    pub parts: &'static [&'static str],
}

impl Shader {
    /// The whole source.
    pub fn source(&self) -> String {
        self.parts.concat()
    }
}

/// Exclusive prefix sums: sums of blocks, the sums before each block, the sums before each word.
pub const SCAN: [Shader; 3] = [
    Shader {
        name: "scan_blocks",
        parts: &[GRID, include_str!("gpu/shaders/scan_blocks.wgsl")],
    },
    Shader {
        name: "scan_sums",
        parts: &[GROUP_SCAN, include_str!("gpu/shaders/scan_sums.wgsl")],
    },
    Shader {
        name: "scan_apply",
        parts: &[GRID, GROUP_SCAN, include_str!("gpu/shaders/scan_apply.wgsl")],
    },
];

/// Parameters of a sort by the number of keys that the device knows.
pub const SORT_SIZES: Shader = Shader {
    name: "sort_sizes",
    parts: &[include_str!("gpu/shaders/sort_sizes.wgsl")],
};

/// A pass of the stable radix sort: digits of blocks, keys to their places.
pub const SORT: [Shader; 2] = [
    Shader {
        name: "sort_count",
        parts: &[GRID, include_str!("gpu/shaders/sort_count.wgsl")],
    },
    Shader {
        name: "sort_scatter",
        parts: &[GRID, GROUP_SCAN, include_str!("gpu/shaders/sort_scatter.wgsl")],
    },
];
