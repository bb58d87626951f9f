//! Edits as one line of text, for command lines and histories:
//!
//! ```text
//! OPERATION [KEY=VALUE ..] [[+|-|&]SHAPE [KEY=VALUE ..]] ..
//! ```
//!
//! `+` adds a shape to the selection (the default without a sign), `-` subtracts it, `&` intersects. Values are numbers, words, vectors
//! (`1,2,3`) and lists of vectors (`0,0;1,0;1,1`, a single one as `0,0;`); `camera.size=640,480` is a key of a table. Text in quotes,
//! such as `"my scene.ply"`, is one word and never a number, and so is a name. Keys are the same as in TOML, so that a new operation or
//! shape needs no change here unless it has a name.

use crate::{Edit, EditError};
use std::fmt;
use std::str::FromStr;
use toml::{Table, Value};

/// Keeps spaces within a word.
const QUOTE: char = '"';
/// Keys of names, which may look like numbers.
const NAME_KEYS: [&str; 2] = ["file", "name"];

impl FromStr for Edit {
    type Err = EditError;

    fn from_str(text: &str) -> Result<Self, EditError> {
        let words = split_words(text)?;
        let mut words = words.iter().map(String::as_str);
        let op = words.next().ok_or_else(|| {
            EditError::Syntax("an empty edit: name an operation, such as: delete sphere center=0,0,0 radius=1".into())
        })?;
        if op.contains('=') {
            return Err(EditError::Syntax(format!(
                "{op}: an edit begins with its operation, such as delete"
            )));
        }
        let mut edit = Table::from_iter([("op".to_owned(), Value::from(op))]);
        let mut steps: Vec<Table> = Vec::new();
        for word in words {
            match word.split_once('=') {
                Some((key, text)) => {
                    let table = steps.last_mut().unwrap_or(&mut edit);
                    let value = if NAME_KEYS.contains(&key) {
                        unquoted(text)
                    } else {
                        parse_value(text)
                    };
                    insert(table, key, value).map_err(|why| EditError::Syntax(format!("{word}: {why}")))?;
                }
                None => {
                    let (mode, shape) = match word.split_at_checked(1) {
                        Some(("+", shape)) => ("add", shape),
                        Some(("-", shape)) => ("subtract", shape),
                        Some(("&", shape)) => ("intersect", shape),
                        _ => ("add", word),
                    };
                    if !shape.starts_with(|c: char| c.is_ascii_alphabetic()) {
                        let hint = "a key is written KEY=VALUE, without spaces, such as center=1,2,3";
                        return Err(EditError::Syntax(format!("{word}: not a shape; {hint}")));
                    }
                    let entries = [("mode", mode), ("shape", shape)];
                    steps.push(entries.into_iter().map(|(k, v)| (k.to_owned(), v.into())).collect());
                }
            }
        }
        if !steps.is_empty() {
            let steps = steps.into_iter().map(Value::Table).collect();
            edit.insert("select".into(), Value::Array(steps));
        }
        Edit::from_table(edit)
    }
}

/// Splits `text` into words, which keep their quotes.
fn split_words(text: &str) -> Result<Vec<String>, EditError> {
    let (mut words, mut word, mut quoted) = (Vec::new(), String::new(), false);
    for c in text.chars() {
        quoted ^= c == QUOTE;
        if c.is_whitespace() && !quoted {
            words.push(std::mem::take(&mut word));
        } else {
            word.push(c);
        }
    }
    if quoted {
        return Err(EditError::Syntax(format!("{word}: a quote is not closed")));
    }
    words.push(word);
    words.retain(|word| !word.is_empty());
    Ok(words)
}

/// Inserts `value` under `key`; the first dot in the key opens a table.
fn insert(table: &mut Table, key: &str, value: Value) -> Result<(), &'static str> {
    let reserved = ["op", "select", "mode", "shape"];
    if key.is_empty() || reserved.contains(&key) {
        return Err("not a key");
    }
    let (table, key) = match key.split_once('.') {
        None => (table, key),
        Some((outer, inner)) => {
            let entry = table.entry(outer).or_insert_with(|| Value::Table(Table::new()));
            (entry.as_table_mut().ok_or("given twice")?, inner)
        }
    };
    match table.insert(key.to_owned(), value) {
        None => Ok(()),
        Some(_) => Err("given twice"),
    }
}

/// Parses a number, a vector, a list of vectors or a Boolean; anything else, and anything in quotes, is a word.
fn parse_value(text: &str) -> Value {
    if text.contains(QUOTE) {
        return unquoted(text);
    }
    let vector = |text: &str| -> Option<Value> {
        let numbers: Option<Vec<Value>> = text.split(',').map(number).collect();
        Some(Value::Array(numbers?))
    };
    let found = if text.contains(';') {
        let vectors: Option<Vec<Value>> = text.split(';').filter(|v| !v.is_empty()).map(vector).collect();
        vectors.map(Value::Array)
    } else if text.contains(',') {
        vector(text)
    } else {
        text.parse().map(Value::Boolean).ok().or_else(|| number(text))
    };
    found.unwrap_or_else(|| text.into())
}

/// An integer, also in the form `1e6`, or another number.
fn number(text: &str) -> Option<Value> {
    if let Ok(whole) = text.parse() {
        return Some(Value::Integer(whole));
    }
    let number: f64 = text.parse().ok()?;
    let is_whole = text.contains(['e', 'E']) && number.fract() == 0.0 && number.abs() < 1e15;
    Some(if is_whole {
        Value::Integer(number as i64)
    } else {
        Value::Float(number)
    })
}

fn unquoted(text: &str) -> Value {
    text.replace(QUOTE, "").into()
}

impl fmt::Display for Edit {
    /// The edit in one line, which parses to the same edit unless a name contains quotes.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let mut edit = Table::try_from(self).map_err(|_| fmt::Error)?;
        f.write_str(self.op.name())?;
        let select = edit.remove("select");
        edit.remove("op");
        write_keys(f, "", &edit)?;
        for step in select.iter().flat_map(|steps| steps.as_array()).flatten() {
            let Some(step) = step.as_table() else { continue };
            let text = |key: &str| step.get(key).and_then(Value::as_str).unwrap_or_default();
            let sign = match text("mode") {
                "subtract" => "-",
                "intersect" => "&",
                _ => "",
            };
            write!(f, " {sign}{}", text("shape"))?;
            let keys = step
                .iter()
                .filter(|(key, _)| !["mode", "shape"].contains(&key.as_str()));
            write_keys(f, "", &keys.map(|(k, v)| (k.clone(), v.clone())).collect())?;
        }
        Ok(())
    }
}

fn write_keys(f: &mut fmt::Formatter, prefix: &str, table: &Table) -> fmt::Result {
    for (key, value) in table {
        match value {
            Value::Table(inner) => write_keys(f, &format!("{prefix}{key}."), inner)?,
            Value::Array(items) if items.iter().any(Value::is_array) => {
                let vectors: Vec<String> = items.iter().map(format_value).collect();
                let end = if vectors.len() == 1 { ";" } else { "" };
                write!(f, " {prefix}{key}={}{end}", vectors.join(";"))?;
            }
            value => write!(f, " {prefix}{key}={}", format_value(value))?,
        }
    }
    Ok(())
}

fn format_value(value: &Value) -> String {
    match value {
        Value::String(text) if text.contains(char::is_whitespace) || !self::parse_value(text).is_str() => {
            format!("{QUOTE}{text}{QUOTE}")
        }
        Value::String(text) => text.clone(),
        Value::Float(number) => number.to_string(),
        Value::Array(items) => items.iter().map(format_value).collect::<Vec<_>>().join(","),
        other => other.to_string(),
    }
}
