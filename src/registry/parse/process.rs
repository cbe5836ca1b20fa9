//! `[device.NAME.process]`: the settings of a program that reads a device.

use std::time::Duration;

use toml::de::DeValue;

use crate::modality::ModalityKind;
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{Hook, Opens, ProcessSpec};
use crate::registry::words::KINDS;

const KEYS: [&str; 7] = ["args", "opens", "kind", "channels", "width", "height", "heartbeat"];
/// As good as any program that only looks whether its device still answers once a second.
const DEFAULT_HEARTBEAT: Duration = Duration::from_secs(2);

/// How an entry's `program` is run and how long it may be silent; `None` if a problem with it was reported.
pub(super) fn process(
    section: &Section<'_>,
    program: Option<Hook>,
    problems: &mut Problems<'_>,
) -> Option<(ProcessSpec, Duration)> {
    for key in ["camera", "serial"].into_iter().filter(|key| section.is_table(key)) {
        let message = format!("a program has no table [{}]", section.child(key));
        section.report(problems, key, message, format!("write its settings into [{}]", section.child("process")));
    }
    if section.has("stall_after") {
        let fix = format!("write heartbeat in [{}]", section.child("process"));
        section.report(problems, "stall_after", "a program has a heartbeat instead of stall_after".to_owned(), fix);
    }
    let bare = |Hook { program, args }| ProcessSpec {
        program,
        args,
        opens: Opens::Usb,
        kind: ModalityKind::Bytes,
        shape: Vec::new(),
    };
    let Some(table) = section.table(problems, "process") else { return Some((bare(program?), DEFAULT_HEARTBEAT)) };
    table.allow(problems, &KEYS);
    let given = args(&table, problems);
    if table.has("args") && program.as_ref().is_some_and(|program| !program.args.is_empty()) {
        let fix = "keep those of on_attach or these".to_owned();
        table.report(problems, "args", "on_attach gives the program arguments already".to_owned(), fix);
    }
    let opens = table.choice(problems, "opens", &Opens::WORDS).unwrap_or(Opens::Usb);
    let kind = table.choice(problems, "kind", &KINDS).unwrap_or(ModalityKind::Bytes);
    let shape = shape(&table, kind, problems);
    let range = Duration::from_millis(10)..=Duration::from_hours(1);
    let heartbeat = table.duration(problems, "heartbeat", range).unwrap_or(DEFAULT_HEARTBEAT);
    let mut process = ProcessSpec { opens, kind, shape, ..bare(program?) };
    process.args.extend(given);
    Some((process, heartbeat))
}

fn args(table: &Section<'_>, problems: &mut Problems<'_>) -> Vec<String> {
    let Some((_, _, value)) = table.fields().into_iter().find(|(_, key, _)| *key == "args") else { return Vec::new() };
    let DeValue::Array(items) = value.get_ref() else {
        let fix = "write args = [\"--rate\", \"100\"]: one text for each argument";
        table.report(problems, "args", "args must be a list of texts".to_owned(), fix);
        return Vec::new();
    };
    let mut args = Vec::new();
    for item in items {
        match item.get_ref() {
            DeValue::String(text) if !text.contains('\0') => args.push(text.clone().into_owned()),
            DeValue::String(_) => {
                let message = "an argument cannot contain the character U+0000";
                problems.report(item.span().start, &table.entry, message, "leave it out");
            }
            _ => {
                problems.report(item.span().start, &table.entry, "an argument must be text", "put it in double quotes");
            }
        }
    }
    args
}

/// What a sample's shape is, from the keys that belong to its kind.
fn shape(table: &Section<'_>, kind: ModalityKind, problems: &mut Problems<'_>) -> Vec<u32> {
    let (word, keys): (&str, &[(&str, i64)]) = match kind {
        ModalityKind::Scalars => ("scalars", &[("channels", 1024)]),
        ModalityKind::Image => ("image", &[("height", 8192), ("width", 8192)]),
        ModalityKind::Bytes => ("bytes", &[]),
    };
    for key in ["channels", "width", "height"] {
        if table.has(key) && !keys.iter().any(|(own, _)| *own == key) {
            let owner = if key == "channels" { "scalars" } else { "image" };
            let message = format!("samples of kind {word:?} have no {key}");
            table.report(problems, key, message, format!("remove {key}, or write kind = {owner:?}"));
        }
    }
    let mut shape = Vec::new();
    for (key, most) in keys {
        if !table.has(key) {
            table.missing(problems, key, &format!("samples of kind {word:?} need it: write {key} = a whole number"));
        }
        let found = table.integer(problems, key, 1..=*most).and_then(|found| u32::try_from(found.value).ok());
        shape.push(found.unwrap_or(1));
    }
    shape
}
