//! Lines for the user of the program: each kind of refusal is reported once, however often it happens.

use std::collections::HashSet;
use std::fmt::Display;
use std::sync::{Mutex, PoisonError};

/// Receives one line at a time.
pub type LineSink = Box<dyn Fn(&str) + Send + Sync>;

pub(crate) struct Notices {
    sink: LineSink,
    reported: Mutex<HashSet<&'static str>>,
}

impl Notices {
    pub fn new(sink: LineSink) -> Self {
        Self {
            sink,
            reported: Mutex::default(),
        }
    }

    /// Reports `line` if nothing of this `kind` has been reported.
    pub fn report_once(&self, kind: &'static str, line: impl Display) {
        let mut reported = self.reported.lock().unwrap_or_else(PoisonError::into_inner);
        if reported.insert(kind) {
            (self.sink)(&line.to_string());
        }
    }

    /// Reports `line`.
    pub fn report(&self, line: impl Display) {
        (self.sink)(&line.to_string());
    }
}
