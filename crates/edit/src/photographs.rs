use irradia_scene::Photo;
use std::fmt::{Debug, Formatter};
use std::sync::{Arc, LazyLock};

/// Small photographs of a scene, by which the search for floaters judges; they are read when they are first needed, and shared.
#[derive(Clone)]
pub struct Photographs(Arc<Lazy>);

type Lazy = LazyLock<Option<Taken>, Box<dyn FnOnce() -> Option<Taken> + Send>>;

/// Photographs in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct Taken {
    /// The number of a camera in [`Draft::cameras`](crate::Draft), and what it took, over the background: 3 channels, of any size.
    pub photos: Vec<(usize, Photo)>,
    /// What the scene is rendered over, sRGB.
    pub background: [f32; 3],
}

impl Photographs {
    /// Those that `read` returns, `None` if they are not to be had.
    pub fn new(read: impl FnOnce() -> Option<Taken> + Send + 'static) -> Self {
        Self(Arc::new(LazyLock::new(Box::new(read))))
    }

    /// The photographs, if they are to be had.
    pub fn taken(&self) -> Option<&Taken> {
        self.0.as_ref().as_ref()
    }
}

impl Debug for Photographs {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        f.write_str("Photographs")
    }
}

impl PartialEq for Photographs {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }
}
