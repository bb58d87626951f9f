//! Lines for the user of the program: each kind of refusal is reported once, however often it happens.

use std::collections::HashSet;
use std::fmt::Display;
use std::sync::{Mutex, PoisonError};

/// Receives one line at a time.
pub type Tell = Box<dyn Fn(&str) + Send + Sync>;

pub(crate) struct Notices {
    tell: Tell,
    told: Mutex<HashSet<&'static str>>,
}

impl Notices {
    pub fn new(tell: Tell) -> Self {
        Self {
            tell,
            told: Mutex::default(),
        }
    }

    /// Reports `line` if nothing of this `kind` has been reported.
    pub fn once(&self, kind: &'static str, line: impl Display) {
        let mut told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
        if told.insert(kind) {
            (self.tell)(&line.to_string());
        }
    }

    /// Reports `line`.
    pub fn always(&self, line: impl Display) {
        (self.tell)(&line.to_string());
    }
}
