//! Words of a text file of numbers, separated by white space.

use crate::Malformed;
use std::str::{FromStr, SplitWhitespace};

/// The unread words of a text.
pub(super) struct Tokens<'a> {
    words: SplitWhitespace<'a>,
}

impl<'a> Tokens<'a> {
    pub fn new(text: &'a str) -> Self {
        Self {
            words: text.split_whitespace(),
        }
    }

    /// The next number; `label` names it in the error.
    pub fn next<T: FromStr>(&mut self, label: &str) -> Result<T, Malformed> {
        let word = self
            .words
            .next()
            .ok_or_else(|| Malformed(format!("ends where {label} is expected; the file is truncated")))?;
        word.parse()
            .map_err(|_| Malformed(format!("`{word}` found where {label} is expected")))
    }

    /// The next `N` numbers.
    pub fn numbers<const N: usize>(&mut self, label: &str) -> Result<[f64; N], Malformed> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.next(label)?;
        }
        Ok(numbers)
    }

    /// Skips `count` words.
    pub fn skip(&mut self, count: usize, label: &str) -> Result<(), Malformed> {
        for _ in 0..count {
            if self.words.next().is_none() {
                return Err(Malformed(format!("ends within {label}; the file is truncated")));
            }
        }
        Ok(())
    }
}
