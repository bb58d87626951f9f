//! The source text of the compute shaders, for the feature `gpu` and for anything else that runs WGSL, such as browsers.

/// `group_index`: the number of a workgroup, for kernels whose workgroups are dispatched in rows.
pub const GRID: &str = include_str!("gpu/shaders/grid.wgsl");
/// `adam`: one step.
pub const ADAM: &str = include_str!("gpu/shaders/adam.wgsl");
/// `basis`: real spherical harmonics of a direction, and `basis_vjp`.
pub const HARMONICS: &str = include_str!("gpu/shaders/harmonics.wgsl");
const GROUP_SCAN: &str = include_str!("gpu/shaders/scan_group.wgsl");

/// The source of a kernel. Its entry point is `main`; its bindings are those of group 0, in order, and all are used.
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

/// Declares kernels by name, each with the parts that precede its own text, the file `gpu/shaders/NAME.wgsl` beside the declaring file.
/// Defines `SHADERS`, the source of each kernel, and with the feature `gpu` also `Kernels`, all of them compiled.
#[macro_export]
macro_rules! kernels {
    ($($(#[$doc:meta])* $name:ident: [$($part:expr),* $(,)?],)*) => {
        /// Every kernel's source, in the order of [`Kernels`], without constants.
        pub const SHADERS: &[$crate::shaders::Shader] = &[$($crate::shaders::Shader {
            name: stringify!($name),
            parts: &[$($part,)* include_str!(concat!("gpu/shaders/", stringify!($name), ".wgsl"))],
        },)*];

        /// The kernels, compiled.
        #[cfg(feature = "gpu")]
        #[derive(Debug)]
        pub(crate) struct Kernels {
            $($(#[$doc])* pub $name: $crate::gpu::Kernel,)*
        }

        #[cfg(feature = "gpu")]
        impl Kernels {
            /// Compiles all kernels, with the text `constants` before each source.
            pub fn new(gpu: &$crate::gpu::Gpu, constants: &str) -> Self {
                let mut shaders = SHADERS.iter();
                let mut next = || {
                    let shader = shaders.next().expect("a shader for each kernel");
                    $crate::gpu::Kernel::with_constants(gpu, shader, constants)
                };
                Self { $($name: next(),)* }
            }
        }
    };
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

/// Parameters of a sort, from the number of keys on the device.
pub const SORT_SIZES: Shader = Shader {
    name: "sort_sizes",
    parts: &[include_str!("gpu/shaders/sort_sizes.wgsl")],
};

/// A pass of the stable radix sort: the counts of digits in each block, their sums before each block, and the scatter of the keys.
pub const SORT: [Shader; 3] = [
    Shader {
        name: "sort_count",
        parts: &[GRID, include_str!("gpu/shaders/sort_count.wgsl")],
    },
    Shader {
        name: "sort_starts",
        parts: &[include_str!("gpu/shaders/sort_starts.wgsl")],
    },
    Shader {
        name: "sort_scatter",
        parts: &[GRID, GROUP_SCAN, include_str!("gpu/shaders/sort_scatter.wgsl")],
    },
];
