//! The reference of all keys, and the schema for editors, from their declarations.

use std::fmt::Write as _;

use serde_json::{Map, Value as Json, json};

use super::{About, Key, Keys, NEEDED};
use crate::parse::ROOT;

/// The schema of `devices.toml` (JSON Schema, draft 7), for editors.
pub fn schema_text() -> String {
    format!("{:#}\n", schema())
}

fn schema() -> Json {
    let mut schema = table(&[ROOT]);
    schema["$schema"] = json!("http://json-schema.org/draft-07/schema#");
    schema["title"] = json!("devices.toml of rapid");
    schema
}

fn table(keys: Keys) -> Json {
    let all = || keys.iter().copied().flatten();
    let properties: Map<String, Json> = all().map(|key| (key.name.to_owned(), value(key))).collect();
    let needed: Vec<&str> = all().filter(|key| (key.default)() == NEEDED).map(|key| key.name).collect();
    json!({"type": "object", "properties": properties, "additionalProperties": false, "required": needed})
}

fn value(key: &Key) -> Json {
    let (words, mut schema) = match (key.about)() {
        About::Value(words, schema) => (format!(" ({words})"), schema),
        About::Table(keys) => (String::new(), table(keys)),
        About::List(keys) => (String::new(), json!({"type": "array", "items": table(keys)})),
        About::Named(keys) => (String::new(), json!({"type": "object", "additionalProperties": table(keys)})),
    };
    schema["description"] = json!(format!("{}{words}", key.meaning.trim()));
    // A default in words is part of the reference alone.
    if let Ok(default) = serde_json::from_str::<Json>(&(key.default)()) {
        schema["default"] = default;
    }
    schema
}

/// The reference of all keys, in Markdown: a part for each table.
pub fn reference() -> String {
    let mut text = String::from(
        "# Keys of devices.toml\n\n\
         Every key with its values and its default, as `rapid keys` prints them. What they are for:\n\
         [The registry](registry.md), [Motors](motors.md), [Network](network.md), [Programs](nodes.md).\n",
    );
    part(&mut text, &mut Vec::new(), ("", "[]"), &[ROOT]);
    text
}

/// The table of this name and title with its keys, then the tables below it. What a table `before` has too is not repeated.
fn part(text: &mut String, before: &mut Vec<(String, String)>, (name, title): (&str, &str), keys: Keys) {
    let (mut rows, mut below) = (String::new(), Vec::new());
    for key in keys.iter().copied().flatten() {
        let path = if name.is_empty() { key.name.to_owned() } else { format!("{name}.{}", key.name) };
        match (key.about)() {
            About::Value(words, _) => rows += &row(key, &words),
            About::Table(keys) => below.push((format!("[{path}]"), path, keys)),
            About::List(keys) => below.push((format!("[[{path}]]"), path, keys)),
            About::Named(keys) => below.push((format!("[{path}.NAME]"), format!("{path}.NAME"), keys)),
        }
    }
    // Writing to a String cannot fail.
    if let Some((_, same)) = before.iter().find(|(earlier, _)| *earlier == rows && !rows.is_empty()) {
        let _ = write!(text, "\n## `{title}`\n\nAs `{same}`.\n");
        return;
    }
    if !rows.is_empty() {
        let _ = write!(text, "\n## `{title}`\n\n| key | value | default | meaning |\n|---|---|---|---|\n{rows}");
    }
    before.push((rows, title.to_owned()));
    for (title, name, keys) in below {
        part(text, before, (&name, &title), keys);
    }
}

fn row(key: &Key, words: &str) -> String {
    let default = (key.default)();
    let default = if serde_json::from_str::<Json>(&default).is_ok() { format!("`{default}`") } else { default };
    format!("| `{}` | {words} | {default} | {} |\n", key.name, key.meaning.trim())
}

#[cfg(test)]
mod tests;
