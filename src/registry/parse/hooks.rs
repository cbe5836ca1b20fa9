//! `on_attach`, `on_detach`, `on_record_start`, `on_record_stop`: programs with their arguments.

use super::program::{For, Programs};
use crate::registry::section::{Problems, Section};
use crate::registry::spec::{Hook, Hooks};

/// The hooks of an entry. With `node = "process"`, `on_attach` is the node itself and no hook.
pub(super) fn hooks(
    section: &Section<'_>,
    attach_is_node: bool,
    programs: Programs<'_>,
    problems: &mut Problems<'_>,
) -> Hooks {
    let mut read = |key| hook(section, key, programs, problems);
    Hooks {
        attach: if attach_is_node { None } else { read("on_attach") },
        detach: read("on_detach"),
        record_start: read("on_record_start"),
        record_stop: read("on_record_stop"),
    }
}

/// A program and its arguments; `None` without the key, or if a problem with it was reported.
pub(super) fn hook(
    section: &Section<'_>,
    key: &'static str,
    programs: Programs<'_>,
    problems: &mut Problems<'_>,
) -> Option<Hook> {
    let words = section.texts(problems, key)?;
    let Some((name, args)) = words.split_first() else {
        let fix = format!("write {key} = [\"program\", \"argument\"], or remove it");
        section.report(problems, key, format!("{key} names no program"), fix);
        return None;
    };
    if args.iter().any(|arg| arg.contains('\0')) {
        let message = format!("{key}: an argument cannot contain the character U+0000");
        section.report(problems, key, message, "leave it out");
        return None;
    }
    let found = programs.find(For::Hook(key), name);
    let program = found.map_err(|(message, fix)| section.report(problems, key, message, fix)).ok()?;
    Some(Hook { program, args: args.to_vec() })
}
