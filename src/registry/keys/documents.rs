//! The reference of all keys, and the schema for editors, from their declarations.

use std::fmt::Write as _;

use serde_json::{Map, Value as Json, json};

use super::{About, Key, Keys};
use crate::parse::ROOT;

/// The schema of `devices.toml` (JSON Schema, draft 7), for editors.
pub fn schema() -> Json {
    let mut schema = table(&[ROOT]);
    if let Json::Object(fields) = &mut schema {
        fields.insert("$schema".to_owned(), json!("http://json-schema.org/draft-07/schema#"));
        fields.insert("title".to_owned(), json!("devices.toml of rapid"));
    }
    schema
}

fn table(keys: Keys) -> Json {
    let properties: Map<String, Json> =
        keys.iter().copied().flatten().map(|key| (key.name.to_owned(), value(key))).collect();
    let needed: Vec<&str> = keys.iter().copied().flatten().filter(|key| key.is_needed).map(|key| key.name).collect();
    json!({"type": "object", "properties": properties, "additionalProperties": false, "required": needed})
}

fn value(key: &Key) -> Json {
    let (words, mut schema) = match (key.about)() {
        About::Value(words, schema) => (Some(words), schema),
        About::Table(keys) => (None, table(keys)),
        About::List(keys) => (None, json!({"type": "array", "items": table(keys)})),
        About::Named(keys) => (None, json!({"type": "object", "additionalProperties": table(keys)})),
    };
    let Json::Object(fields) = &mut schema else { return schema };
    let words = words.map(|words| format!("\n\n{words}")).unwrap_or_default();
    fields.insert("description".to_owned(), json!(format!("{}{words}", key.meaning.trim())));
    // A default in words is part of the reference alone.
    if let Some(default) = (key.default)().and_then(|default| serde_json::from_str::<Json>(&default).ok()) {
        fields.insert("default".to_owned(), default);
    }
    schema
}

/// The reference of all keys, in Markdown: a part for each table.
pub fn reference() -> String {
    let mut text = String::from(
        "# Keys of devices.toml\n\n\
         Every key, its default and its range, as `rapid` reads them: this page and\n\
         [`devices.schema.json`](devices.schema.json) are generated from their declarations. What they are for is explained in\n\
         [The registry](registry.md). An editor with a language server for TOML (taplo, Even Better TOML) completes and checks\n\
         keys if the first line of the file is `#:schema PATH/devices.schema.json`.\n",
    );
    part(&mut text, "", &[ROOT]);
    text
}

fn part(text: &mut String, name: &str, keys: Keys) {
    let all = || keys.iter().copied().flatten();
    let below = |key: &Key| match (key.about)() {
        About::Value(..) => None,
        About::Table(keys) => Some((format!("{name}{}", key.name), keys)),
        About::List(keys) => Some((format!("{name}{}[]", key.name), keys)),
        About::Named(keys) => Some((format!("{name}{}.NAME", key.name), keys)),
    };
    let values =
        all().filter_map(|key| if let About::Value(words, _) = (key.about)() { Some((key, words)) } else { None });
    let rows: Vec<String> = values.map(|(key, words)| row(key, &words)).collect();
    if !rows.is_empty() {
        // Writing to a String cannot fail.
        let title = name.trim_end_matches('.');
        let _ = write!(
            text,
            "\n## `[{title}]`\n\n| key | value | default | meaning |\n|---|---|---|---|\n{}",
            rows.concat()
        );
    }
    for (name, keys) in all().filter_map(below) {
        part(text, &format!("{name}."), keys);
    }
}

fn row(key: &Key, words: &str) -> String {
    let default = match (key.default)() {
        _ if key.is_needed => "needed".to_owned(),
        Some(default) if serde_json::from_str::<Json>(&default).is_ok() => format!("`{default}`"),
        default => default.unwrap_or_default(),
    };
    let meaning = key.meaning.trim();
    format!("| `{}` | {} | {default} | {meaning} |\n", key.name, words.replace('|', "\\|"))
}
