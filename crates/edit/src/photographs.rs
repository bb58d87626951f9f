use irradia_scene::Photo;
use std::fmt::{Debug, Formatter};
use std::sync::{Arc, LazyLock};

/// Small photographs of a scene, which the search for floaters compares it with; they are shared, and read when they are first needed.
#[derive(Clone)]
pub struct Photographs(Arc<LazyPhotographs>);

type LazyPhotographs = LazyLock<Option<LoadedPhotographs>, Box<dyn FnOnce() -> Option<LoadedPhotographs> + Send>>;

/// Photographs in memory.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedPhotographs {
    /// The index of a camera in [`Draft::cameras`](crate::Draft), and its photograph over the background: 3 channels, of any size.
    pub photos: Vec<(usize, Photo)>,
    /// The background that the scene is rendered over, sRGB.
    pub background: [f32; 3],
}

impl Photographs {
    /// The photographs that `read` returns; `None` if they are not available.
    pub fn new(read: impl FnOnce() -> Option<LoadedPhotographs> + Send + 'static) -> Self {
        Self(Arc::new(LazyLock::new(Box::new(read))))
    }

    /// The photographs, if they are available.
    pub fn load(&self) -> Option<&LoadedPhotographs> {
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
