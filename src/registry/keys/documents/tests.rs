use std::path::{Path, PathBuf};

use super::*;
use crate::kinds::{KEYS, Word};

fn committed(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path)
}

fn texts(folder: &str) -> Vec<(String, String)> {
    let files = std::fs::read_dir(committed(folder)).unwrap().map(|entry| entry.unwrap().path());
    let registries = files.filter(|path| path.extension().is_some_and(|extension| extension == "toml"));
    registries.map(|path| (path.display().to_string(), std::fs::read_to_string(path).unwrap())).collect()
}

/// Why a value does not match the schema, as far as types, keys, words and ranges tell.
fn mismatch(schema: &Json, value: &Json, at: &str) -> Option<String> {
    let wrong = |what: &str| Some(format!("{at}: {what}"));
    if let Some(ways) = schema["anyOf"].as_array() {
        let fits = ways.iter().any(|way| mismatch(way, value, at).is_none());
        return if fits { None } else { wrong("none of several") };
    }
    if let Some(words) = schema["enum"].as_array() {
        return if words.contains(value) { None } else { wrong("no such word") };
    }
    let types = match &schema["type"] {
        Json::Array(types) => types.clone(),
        one => vec![one.clone()],
    };
    let is = |of: &Json| match of.as_str().unwrap() {
        "integer" => value.is_i64(),
        "number" => value.is_number(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "array" => value.is_array(),
        "object" => value.is_object(),
        other => panic!("{other}"),
    };
    if !types.iter().any(is) {
        return wrong(&format!("{value} is not {types:?}"));
    }
    let number = value.as_f64();
    if number.zip(schema["minimum"].as_f64()).is_some_and(|(number, least)| number < least)
        || number.zip(schema["maximum"].as_f64()).is_some_and(|(number, most)| number > most)
    {
        return wrong(&format!("{value} is out of range"));
    }
    if let (Some(items), false) = (value.as_array(), schema["items"].is_null()) {
        return items.iter().find_map(|item| mismatch(&schema["items"], item, &format!("{at}[]")));
    }
    let (Some(fields), false) = (value.as_object(), schema["additionalProperties"].is_null()) else { return None };
    let missing =
        schema["required"].as_array().into_iter().flatten().find(|key| fields.get(key.as_str().unwrap()).is_none());
    missing.map(|key| format!("{at}: {key} is missing")).or_else(|| {
        fields.iter().find_map(|(key, value)| {
            let path = format!("{at}.{key}");
            match (schema["properties"].get(key), &schema["additionalProperties"]) {
                (Some(own), _) => mismatch(own, value, &path),
                (None, Json::Bool(false)) => Some(format!("{path}: unknown key")),
                (None, any) => mismatch(any, value, &path),
            }
        })
    })
}

fn judged(text: &str) -> Option<String> {
    let value: Json = toml::from_str(text).unwrap();
    mismatch(&schema(), &value, "")
}

#[test]
fn the_committed_reference_and_schema_are_generated() {
    let read = |path: &str| std::fs::read_to_string(committed(path)).unwrap_or_default();
    assert!(read("docs/keys.md") == reference(), "rapid keys > docs/keys.md");
    assert!(read("docs/devices.schema.json") == schema_text(), "rapid keys --schema > docs/devices.schema.json");
}

#[test]
fn every_valid_registry_fits_the_schema() {
    for (path, text) in texts("tests/registry/valid") {
        assert_eq!(judged(&text), None, "{path}");
    }
    assert_eq!(judged(crate::BUILTIN), None);
}

#[test]
fn an_unknown_key_a_wrong_type_or_word_does_not_fit_the_schema() {
    let invalid = texts("tests/registry/invalid");
    let of = [
        "unknown_key",
        "unknown_word",
        "unknown_type",
        "unknown_mode",
        "unknown_format",
        "unknown_parse",
        "not_a_list",
    ];
    let judged: Vec<_> = invalid
        .iter()
        .filter(|(path, _)| of.iter().any(|name| path.contains(name)))
        .map(|(path, text)| (path, judged(text)))
        .collect();
    assert!(judged.len() > 20, "{}", judged.len());
    for (path, mismatch) in judged {
        assert!(mismatch.is_some(), "{path}");
    }
}

#[test]
fn every_key_has_a_meaning_and_no_table_has_one_twice() {
    fn check(name: &str, keys: Keys) {
        let all: Vec<&Key> = keys.iter().copied().flatten().collect();
        for (at, key) in all.iter().enumerate() {
            assert!(
                key.meaning.trim().ends_with('.') && !key.meaning.contains("[`"),
                "{name}.{}: {}",
                key.name,
                key.meaning
            );
            assert!(!all.iter().take(at).any(|other| other.name == key.name), "{name}.{} twice", key.name);
            if let About::Table(keys) | About::List(keys) | About::Named(keys) = (key.about)() {
                check(key.name, keys);
            }
        }
    }
    check("", &[ROOT]);
}

/// A kind that is only listed would be read, and no reader of the documents would learn of it.
#[test]
fn every_kind_of_device_is_documented_and_among_the_tests_of_registries() {
    let schema = schema();
    let device = &schema["properties"]["device"]["additionalProperties"]["properties"];
    let (valid, invalid) = (texts("tests/registry/valid"), texts("tests/registry/invalid"));
    let tables = KEYS[2];
    assert_eq!(tables.len(), Word::ALL.len());
    for ((word, _), table) in Word::ALL.iter().zip(tables) {
        let written = format!("{word:?}");
        assert!(
            device["node"]["description"].as_str().unwrap().contains(&written),
            "{written} is not a value of `node`"
        );
        assert!(device[table.name]["properties"].is_object(), "[{}] of {written} is not in the schema", table.name);
        for (folder, registries) in [("valid", &valid), ("invalid", &invalid)] {
            let is_there = registries.iter().any(|(_, text)| text.contains(&format!("node = {written}")));
            assert!(is_there, "tests/registry/{folder} has no device of kind {written}");
        }
    }
}
