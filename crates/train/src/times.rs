//! The time breakdown of a run.

/// Wall-clock seconds between a run's first step and its last, with their breakdown; over all sessions of a resumed run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Times {
    /// Total; the part in neither the fields below nor `Trainer::seconds` is spent on events and forecasts.
    pub wall: f64,
    /// Loading photographs.
    pub loading: f64,
    /// Density control, which `Trainer::seconds` includes.
    pub density: f64,
    /// Evaluating held-out views.
    pub evaluating: f64,
    /// Writing checkpoints.
    pub saving: f64,
    /// Paused.
    pub paused: f64,
}

impl Times {
    /// In the order of the fields.
    pub(crate) fn to_array(self) -> [f64; 6] {
        let Self {
            wall,
            loading,
            density,
            evaluating,
            saving,
            paused,
        } = self;
        [wall, loading, density, evaluating, saving, paused]
    }

    /// From [`Self::to_array`].
    pub(crate) fn from_array([wall, loading, density, evaluating, saving, paused]: [f64; 6]) -> Self {
        Self {
            wall,
            loading,
            density,
            evaluating,
            saving,
            paused,
        }
    }
}
