//! The programs that an entry names, and its hooks `on_attach`, `on_detach`, `on_record_start` and `on_record_stop`:
//! programs with their arguments.
//!
//! 1. An absolute path is used as it is.
//! 2. A name is searched for beside the registry's file, then in the absolute directories of `PATH`.
//!
//! Invariant: a program that others could change is rejected as root, and causes a warning otherwise.

use std::ffi::OsString;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use super::device::Draft;
use crate::diagnostic::nearest;
use crate::kinds::Word;
use crate::section::{Section, printable};
use crate::spec::{Hook, Hooks};
use crate::trust::distrust;

/// Number of files beside the registry that are compared with a name that is not found.
const MOST_COMPARED: usize = 1000;

/// Where programs are searched for.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Programs<'a> {
    /// Beside this file and on `PATH`.
    Beside(&'a Path),
    /// Nowhere: no program will be run, any name is valid.
    Nowhere,
}

/// The key that names the program, for messages.
#[derive(Debug, Clone, Copy)]
pub(crate) enum For {
    /// `node`, which may also be the word for a built-in node.
    Node,
    /// The first text of this key.
    Hook(&'static str),
}

impl For {
    const fn key(self) -> &'static str {
        match self {
            Self::Node => "node",
            Self::Hook(key) => key,
        }
    }
}

/// What is wrong, and the fix.
type Wrong = (String, String);

impl Programs<'_> {
    /// The path of a file that the registry names: relative to its own.
    pub(crate) fn file(self, name: &str) -> PathBuf {
        match self {
            Self::Beside(registry) => registry.parent().unwrap_or(Path::new("")).join(name),
            Self::Nowhere => PathBuf::from(name),
        }
    }

    /// Whether this is a registry whose programs will not be run, such as that of an episode.
    pub(crate) const fn are_nowhere(self) -> bool {
        matches!(self, Self::Nowhere)
    }

    /// The program of this name.
    pub(crate) fn find(self, purpose: For, name: &str) -> Result<PathBuf, Wrong> {
        let Self::Beside(file) = self else { return Ok(PathBuf::from(name)) };
        let found = if Path::new(name).is_absolute() {
            Some(PathBuf::from(name)).filter(|path| path.exists())
        } else {
            if name.is_empty() || name.contains(['/', '\0']) || name == "." || name == ".." {
                let message = format!("{} {name:?} is not the name of a program", purpose.key());
                return Err((message, "write its name, for a program beside this file, or its absolute path".into()));
            }
            let beside = folder_of(file);
            let path = std::env::var_os("PATH").unwrap_or_default();
            std::iter::once(beside)
                .chain(directories(&path))
                .map(|folder| folder.join(name))
                .find(|path| path.is_file())
        };
        let path = found.ok_or_else(|| self.missing(purpose, name))?;
        check(&path)?;
        Ok(path)
    }

    fn missing(self, purpose: For, name: &str) -> Wrong {
        let place = "a program must lie beside this file or on PATH, or be written with its absolute path";
        let (message, otherwise) = match purpose {
            For::Node => (
                format!("node {name:?} is neither built in nor a program"),
                format!("built in are camera, serial, can and lan; {place}"),
            ),
            For::Hook(key) => (format!("{key} {name:?} is not a program"), place.to_owned()),
        };
        let near = match self {
            Self::Beside(file) => executables(&folder_of(file)),
            Self::Nowhere => Vec::new(),
        };
        let built_in = Word::ALL.iter().filter(|(_, kind)| matches!(purpose, For::Node) && *kind != Word::Process);
        let known = built_in.map(|(name, _)| *name).chain(near.iter().map(String::as_str));
        let fix = match nearest(name, known) {
            Some(name) => format!("did you mean {name:?}?"),
            None => otherwise,
        };
        (message, fix)
    }
}

/// The folder of the registry's file, as an absolute path: it must be valid wherever a child runs.
fn folder_of(file: &Path) -> PathBuf {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned())
}

/// A relative directory on `PATH` would name another program in each directory `rapid` is started in.
fn directories(path: &OsString) -> Vec<PathBuf> {
    std::env::split_paths(path).filter(|folder| folder.is_absolute()).collect()
}

fn executables(folder: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let runs = |entry: &std::fs::DirEntry| {
        entry.metadata().is_ok_and(|meta| meta.is_file() && meta.permissions().mode() & 0o111 != 0)
    };
    let names = entries.flatten().take(MOST_COMPARED).filter(runs);
    names.filter_map(|entry| entry.file_name().into_string().ok()).collect()
}

/// Whether it can and may be run.
fn check(path: &Path) -> Result<(), Wrong> {
    let label = printable(&path.display().to_string());
    let wrong = |message: &str, fix: String| Err((format!("the program {label} {message}"), fix));
    let meta = match path.metadata() {
        Ok(meta) => meta,
        Err(error) => return wrong(&format!("cannot be inspected: {error}"), "name another program".to_owned()),
    };
    if !meta.is_file() {
        return wrong("is not a file", "name the program itself".to_owned());
    }
    if rustix::fs::access(path, rustix::fs::Access::EXEC_OK).is_err() {
        return wrong("may not be run by this user", format!("chmod +x {label}"));
    }
    trusted(path, &label)
}

/// Any user who may write the program, or exchange it in its folder, decides what root runs.
fn trusted(path: &Path, label: &str) -> Result<(), Wrong> {
    if !rustix::process::geteuid().is_root() {
        return Ok(());
    }
    match distrust(path) {
        Ok(None) => Ok(()),
        Ok(Some(reason)) => Err((format!("the program {label}: {reason}"), reason.fix())),
        Err(error) => {
            Err((format!("the program {label}: cannot be inspected: {error}"), "name another program".to_owned()))
        }
    }
}

/// Warns of the programs of entries that others could change. As root they have been rejected.
pub(crate) fn warn_of_distrusted(drafts: &[Draft<'_>]) {
    for (draft, (key, path)) in drafts.iter().flat_map(|draft| draft.programs().map(move |program| (draft, program))) {
        // A program that is not searched for, because it will not be run, does not exist there either.
        if let Ok(Some(reason)) = distrust(path) {
            let message = format!("the program {}: {reason}", printable(&path.display().to_string()));
            draft.section.warn_at(draft.section.at_of(key), message, reason.fix());
        }
    }
}

/// The hooks of an entry. With `node = "process"`, `on_attach` is the node itself and no hook.
pub(crate) fn hooks(section: &Section<'_>, attach_is_node: bool, programs: Programs<'_>) -> Hooks {
    let read = |key| hook(section, key, programs);
    Hooks {
        attach: if attach_is_node { None } else { read("on_attach") },
        detach: read("on_detach"),
        record_start: read("on_record_start"),
        record_stop: read("on_record_stop"),
    }
}

/// A program and its arguments; `None` without the key, or if a problem with it was reported.
pub(crate) fn hook(section: &Section<'_>, key: &'static str, programs: Programs<'_>) -> Option<Hook> {
    let words = section.texts(key)?;
    let Some((name, args)) = words.split_first() else {
        let fix = format!("write {key} = [\"program\", \"argument\"], or remove it");
        return section.refuse(key, format!("{key} names no program"), fix);
    };
    if args.iter().any(|arg| arg.contains('\0')) {
        let message = format!("{key}: an argument cannot contain the character U+0000");
        return section.refuse(key, message, "leave it out");
    }
    let found = programs.find(For::Hook(key), name);
    let program = found.map_err(|(message, fix)| section.report(key, message, fix)).ok()?;
    Some(Hook { program, args: args.to_vec() })
}

#[cfg(test)]
mod tests {
    use std::fs::{create_dir, set_permissions, write};

    use super::*;

    fn allow(path: &Path, mode: u32) {
        set_permissions(path, PermissionsExt::from_mode(mode)).unwrap();
    }

    #[test]
    fn a_program_is_found_beside_the_file_and_by_its_path() {
        let dir = tempfile::tempdir().unwrap();
        let (file, program) = (dir.path().join("devices.toml"), dir.path().join("tactile_publisher"));
        write(&program, "#!/bin/sh\n").unwrap();
        let programs = Programs::Beside(&file);
        let message = |name: &str| programs.find(For::Node, name).unwrap_err();
        assert!(message("tactile_publisher").0.ends_with("tactile_publisher may not be run by this user"));
        allow(&program, 0o755);
        assert_eq!(programs.find(For::Node, "tactile_publisher").unwrap(), program);
        assert_eq!(programs.find(For::Node, program.to_str().unwrap()).unwrap(), program);
        assert!(programs.find(For::Node, "sh").unwrap().is_absolute(), "on PATH");
        assert_eq!(message("tactile_publishr").1, "did you mean \"tactile_publisher\"?");
        assert_eq!(message("camra").1, "did you mean \"camera\"?");
        assert!(message("/no/such/program").0.contains("neither built in nor a program"));
        create_dir(dir.path().join("folder")).unwrap();
        for name in ["", "a/b", "..", "./x", "a\0b"] {
            assert!(message(name).0.contains("is not the name of a program"), "{name:?}");
        }
        assert!(message("folder").0.contains("neither built in nor a program"));
        assert_eq!(Programs::Nowhere.find(For::Node, "anything").unwrap(), Path::new("anything"));
    }

    #[test]
    fn a_program_that_others_could_change_is_rejected_as_root_and_causes_a_warning_otherwise() {
        use crate::Registry;
        let dir = tempfile::tempdir().unwrap();
        allow(dir.path(), 0o755);
        let (file, program) = (dir.path().join("devices.toml"), dir.path().join("p"));
        write(&program, "").unwrap();
        let entry = "[device.a]\nvid = \"1\"\npid = \"2\"\nbit = 0\n";
        let diagnose = |mode, keys: &str| {
            let text = format!("{entry}{keys}\n");
            allow(&program, mode);
            match Registry::parse(&text, Some(&file)) {
                Ok(loaded) => (loaded.warnings, false),
                Err(errors) => (errors.diagnostics, true),
            }
        };
        for keys in [
            "node = \"p\"",
            "on_record_stop = [\"p\", \"x\"]\nnode = \"camera\"",
            "on_attach = [\"p\"]\nnode = \"process\"",
        ] {
            assert_eq!(diagnose(0o755, keys), (Vec::new(), false));
            let (diagnostics, refused) = diagnose(0o777, keys);
            assert_eq!(refused, rustix::process::geteuid().is_root());
            assert_eq!(diagnostics.len(), 1, "{diagnostics:?}");
            assert!(diagnostics[0].message.ends_with("p: other users may write to it (mode 0777)"), "{diagnostics:?}");
            assert_eq!((diagnostics[0].entry.as_deref(), diagnostics[0].line), (Some("device.a"), 5));
        }
    }

    #[test]
    fn root_runs_only_programs_that_no_other_user_could_have_changed() {
        let dir = tempfile::tempdir().unwrap();
        allow(dir.path(), 0o755);
        let program = dir.path().join("p");
        write(&program, "").unwrap();
        allow(&program, 0o755);
        // Any other user runs what that user may run anyway.
        let refused = || trusted(&program, "p").is_err();
        let is_root = rustix::process::geteuid().is_root();
        assert!(!refused());
        allow(&program, 0o775);
        assert_eq!(refused(), is_root);
        allow(&program, 0o755);
        allow(dir.path(), 0o777);
        assert_eq!(refused(), is_root);
        allow(dir.path(), 0o1777);
        assert!(!refused());
    }
}
