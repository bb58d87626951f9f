//! The subset of XML that camera exports and metadata (XMP) use: elements, attributes, text, and references to characters by their numbers
//! or XML's five predefined names. No document types.

use crate::Malformed;

/// Maximum nesting depth of elements; a deeper file cannot be a list of cameras.
const MAX_DEPTH: usize = 64;
/// Maximum length of a reference to a character, bytes.
const MAX_REFERENCE_BYTES: usize = 12;

/// An element with its contents.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Element {
    /// With its prefix, such as `xcr:Position`.
    pub name: String,
    /// Names and values.
    pub attributes: Vec<(String, String)>,
    /// The elements directly in it.
    pub children: Vec<Element>,
    /// All text directly in it.
    pub text: String,
}

impl Element {
    /// The first child of that name.
    pub fn child(&self, name: &str) -> Option<&Element> {
        self.children.iter().find(|child| child.name == name)
    }

    /// The value of an attribute.
    pub fn attribute(&self, name: &str) -> Option<&str> {
        let found = self.attributes.iter().find(|(own, _)| own == name);
        found.map(|(_, value)| value.as_str())
    }

    /// The elements of that name in this one, at any depth, in order.
    pub fn descendants(&self, name: &str) -> Vec<&Element> {
        let mut found = Vec::new();
        for child in &self.children {
            if child.name == name {
                found.push(child);
            }
            found.extend(child.descendants(name));
        }
        found
    }

    /// The numbers of its text.
    pub fn numbers(&self) -> Vec<f64> {
        numbers(&self.text)
    }
}

/// A property of an XMP packet: an attribute of a description, or an element in it.
pub(crate) fn property<'a>(document: &'a Element, name: &str) -> Option<&'a str> {
    document
        .descendants("rdf:Description")
        .into_iter()
        .find_map(|description| {
            let element = || description.child(name).map(|child| child.text.as_str());
            description.attribute(name).or_else(element)
        })
}

/// The leading numbers of `text`, separated by white space.
pub(crate) fn numbers(text: &str) -> Vec<f64> {
    text.split_whitespace().map_while(|word| word.parse().ok()).collect()
}

/// The root element of a document.
///
/// # Errors
/// When tags do not match, or there is no element.
pub fn parse_xml(bytes: &[u8]) -> Result<Element, Malformed> {
    let text = crate::text::text(bytes);
    let mut rest = &*text;
    // The open elements, the innermost last; the first one is a placeholder that holds the root.
    let mut open = vec![Element::default()];
    while let Some(at) = rest.find('<') {
        let last = open.len() - 1;
        open[last].text.push_str(&unescaped(&rest[..at]));
        rest = &rest[at..];
        let special = [("<!--", "-->"), ("<?", "?>"), ("<![CDATA[", "]]>"), ("<!", ">")];
        if let Some((start, end)) = special.into_iter().find(|(start, _)| rest.starts_with(start)) {
            // Were it skipped as a tag, each of many would be searched to the end of the file.
            let unclosed = || malformed(&format!("a {start} has no {end}"));
            let (content, after) = rest.split_once(end).ok_or_else(unclosed)?;
            if let Some(data) = content.strip_prefix("<![CDATA[") {
                open[last].text.push_str(data);
            }
            rest = after;
            continue;
        }
        let end = end_of_tag(rest).ok_or_else(|| malformed("it ends within a tag"))?;
        let tag = &rest[1..end];
        rest = &rest[end + 1..];
        if let Some(name) = tag.strip_prefix('/') {
            let closed = open
                .pop()
                .filter(|element| element.name == name.trim() && !open.is_empty());
            let Some(element) = closed else {
                return Err(malformed(&format!("</{}> closes nothing", name.trim())));
            };
            push_child(&mut open, element);
            continue;
        }
        let (tag, is_empty) = match tag.strip_suffix('/') {
            Some(tag) => (tag, true),
            None => (tag, false),
        };
        let element = start_tag(tag)?;
        if is_empty {
            push_child(&mut open, element);
        } else if open.len() > MAX_DEPTH {
            return Err(malformed(&format!("elements are nested more than {MAX_DEPTH} deep")));
        } else {
            open.push(element);
        }
    }
    let mut outer = open.swap_remove(0);
    match (open.is_empty(), outer.children.is_empty()) {
        (true, false) => Ok(outer.children.swap_remove(0)),
        (true, true) => Err(malformed("it has no element")),
        (false, _) => Err(malformed("it ends before its elements are closed")),
    }
}

fn malformed(message: &str) -> Malformed {
    Malformed(format!("not usable XML: {message}"))
}

/// Adds `element` to the innermost open one.
fn push_child(open: &mut [Element], element: Element) {
    if let Some(parent) = open.last_mut() {
        parent.children.push(element);
    }
}

/// Position of the `>` that ends the tag at the start of `text`; a quoted `>` does not end it.
fn end_of_tag(text: &str) -> Option<usize> {
    let mut quote = None;
    for (at, byte) in text.bytes().enumerate() {
        match (quote, byte) {
            (None, b'>') => return Some(at),
            (None, b'"' | b'\'') => quote = Some(byte),
            (Some(open), byte) if open == byte => quote = None,
            _ => {}
        }
    }
    None
}

/// An element from the text between its `<` and `>`.
fn start_tag(tag: &str) -> Result<Element, Malformed> {
    let (name, mut rest) = tag.split_at(tag.find(char::is_whitespace).unwrap_or(tag.len()));
    let mut attributes = Vec::new();
    loop {
        rest = rest.trim_start();
        if rest.is_empty() {
            break;
        }
        let no_value = || malformed(&format!("an attribute of <{name}> has no value"));
        let (key, after) = rest.split_once('=').ok_or_else(no_value)?;
        let after = after.trim_start();
        let quote = after
            .chars()
            .next()
            .filter(|c| matches!(c, '"' | '\''))
            .ok_or_else(no_value)?;
        let (value, after) = after[1..].split_once(quote).ok_or_else(no_value)?;
        attributes.push((key.trim().to_owned(), unescaped(value)));
        rest = after;
    }
    Ok(Element {
        name: name.to_owned(),
        attributes,
        ..Element::default()
    })
}

/// `text` with the characters to which it refers, such as `&amp;` and `&#252;`.
fn unescaped(text: &str) -> String {
    let mut unescaped = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find('&') {
        unescaped.push_str(&rest[..at]);
        rest = &rest[at + 1..];
        let end = rest.bytes().take(MAX_REFERENCE_BYTES).position(|byte| byte == b';');
        match end.and_then(|end| Some((referred(&rest[..end])?, end + 1))) {
            Some((character, length)) => {
                unescaped.push(character);
                rest = &rest[length..];
            }
            None => unescaped.push('&'),
        }
    }
    unescaped + rest
}

/// The character of a reference, without its `&` and `;`.
fn referred(name: &str) -> Option<char> {
    match name {
        "lt" => Some('<'),
        "gt" => Some('>'),
        "quot" => Some('"'),
        "apos" => Some('\''),
        "amp" => Some('&'),
        _ => {
            let digits = name.strip_prefix('#')?;
            let hexadecimal = digits.strip_prefix('x').map(|digits| u32::from_str_radix(digits, 16));
            char::from_u32(hexadecimal.unwrap_or_else(|| digits.parse()).ok()?)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_attributes_and_text_are_read() {
        let text = br#"<?xml version="1.0"?><!DOCTYPE d><!-- a > b --><d v='1 "q"'><a n="x&amp;lt;>"/>1 2<b>3<![CDATA[<4>]]></b> 5 x 6</d>"#;
        let root = parse_xml(text).unwrap();
        assert_eq!(root.attribute("v"), Some("1 \"q\""));
        assert_eq!(root.child("a").and_then(|a| a.attribute("n")), Some("x&lt;>"));
        assert_eq!(root.child("b").map(|b| b.text.as_str()), Some("3<4>"));
        assert_eq!(root.numbers(), [1.0, 2.0, 5.0]);
        assert_eq!(root.descendants("b").len(), 1);
    }

    #[test]
    fn references_to_characters_are_resolved_once() {
        for (text, expected) in [
            ("T&#252;r &#xDF;&lt;&gt;&quot;&apos;", "Tür ß<>\"'"),
            ("&amp;lt; &amp;#252;", "&lt; &#252;"),
            (
                "& &; &#; &#x; &#xD800; &#99999999; &other; &amp",
                "& &; &#; &#x; &#xD800; &#99999999; &other; &amp",
            ),
        ] {
            assert_eq!(unescaped(text), expected);
        }
    }

    #[test]
    fn broken_documents_are_rejected() {
        for text in [
            "",
            "no element",
            "<a>",
            "<a></b>",
            "</a>",
            "<a b=1/>",
            "<a b/>",
            "<a",
            "<a b=\"x/>",
            "<!-- a",
            "<a><?b/></a>",
            "<a><!--/></a>",
            "<a><![CDATA[/></a>",
        ] {
            assert!(parse_xml(text.as_bytes()).is_err(), "{text}");
        }
        let deep = "<a>".repeat(100_000);
        assert!(parse_xml(deep.as_bytes()).unwrap_err().to_string().contains("nested"));
    }
}
