//! The architecture as data, and a check that the sources keep to it: what the compiler and its lints cannot say.
//!
//! A folder of src/ with a manifest is a crate, and sees what that names. The other modules lie in layers and import downwards
//! only, and each of their third-party crates has one home. `unsafe` lives at the edge, locks off the path of a sample. A file
//! is as long as its subject: 400 lines are a guide, a function that does not fit on a screen (`too-many-lines-threshold` in
//! clippy.toml) is the rule.
//!
//! What is read are tokens, not text: comments and strings do not count, macros do. Items under
//! `#[cfg(test)]` are left out: a test may build its subject from whatever it likes.
//!
//! A new module gets a line in [`LAYERS`], a new dependency one in [`HOMES`]; if a change needs more
//! than that to pass, the change is what is wrong.

#![allow(clippy::unwrap_used, reason = "what fails here fails a test")]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use proc_macro2::{Delimiter, TokenStream, TokenTree};

/// Modules by layer, lowest first. A module sees those of lower layers.
const LAYERS: &[&[&str]] = &[
    &["orders"],
    &["rig", "alignment", "session", "registration"],
    &["app", "lockstep", "compare"],
    &["main", "dispatch", "cli", "commands"],
];

/// Imports within a layer.
const SIDEWAYS: &[(&str, &[&str])] =
    &[("main", &["dispatch", "cli", "commands"]), ("dispatch", &["cli", "commands"]), ("commands", &["cli"])];

/// The homes of third-party crates: modules, or files of them (`commands/policy`).
const HOMES: &[(&str, &[&str])] = &[
    ("clap", &["cli", "dispatch", "main", "commands"]),
    ("clap_complete", &["cli", "dispatch", "main", "commands"]),
    ("clap_mangen", &["commands"]),
    ("futures", &["rig", "app", "commands"]),
    ("indicatif", &["commands/progress"]),
    ("libc", &["rig", "app"]),
    ("sd_notify", &["app/watchdog"]),
    ("toml", &["session"]),
    ("zip", &["commands/policy"]),
];

/// Third-party crates that any module may name.
const ANYWHERE: &[&str] = &["rustix", "serde", "serde_json", "thiserror", "tokio", "tokio_util", "tracing"];

/// Where `unsafe` may stand: at the borders to the kernel and to shared memory.
const UNSAFE_HOMES: &[&str] = &["devices/driver", "bus", "policy/onnxruntime/loader", "system/peer"];

/// What makes one thread wait for another.
const LOCKS: &[&str] = &["Mutex", "RwLock", "Condvar", "ReentrantMutex", "Semaphore", "Barrier"];

/// Where a lock may stand, and why that holds up no sample.
const LOCK_HOMES: &[(&str, &str)] = &[
    ("bus/shared", "the handle of a loan: made, locked and dropped by one thread"),
    ("status/board", "what a screen shows: written when a state changes and twice a second, read by the screen"),
    (
        "foxglove/client",
        "a client's queue: locked by thread `foxglove` alone, for a type that the library wants to share",
    ),
    ("devices/driver/lan/iphone/clock", "clocks of phones that are away: locked when one connects or is gone"),
    ("rig/hooks", "the hooks of an entry run one after the other"),
    ("rig/worker", "a program waits for the end of the one before"),
    (
        "registry/simulation",
        "the simulated world, which its devices share, and a light that is switched for a calibration",
    ),
    ("policy/onnxruntime", "onnxruntime is loaded once, before the first chunk"),
    ("system/fault", "injected faults, in builds with debug assertions alone"),
    ("system/panics", "messages of panics"),
    ("screens/tui", "the monitor's terminal"),
];

#[test]
fn the_sources_follow_the_architecture() {
    let found = violations(&files(&["src"]), |path| package(path) != Path::new(""));
    assert!(found.is_empty(), "{} violations of the tables in tests/layering.rs:\n{}", found.len(), found.join("\n"));
}

#[test]
fn every_dependency_has_a_home() {
    let manifest = toml("Cargo.toml");
    let all = manifest["dependencies"].as_table().unwrap().keys().map(|name| name.replace('-', "_"));
    // What a crate of this workspace may see is said in its manifest.
    let all: BTreeSet<String> = all.filter(|name| !name.starts_with("rapid_")).collect();
    let known = HOMES.iter().map(|(name, _)| *name).chain(ANYWHERE.iter().copied()).map(str::to_owned).collect();
    assert_eq!(all, known, "the dependencies of Cargo.toml, and those with a home in HOMES or ANYWHERE");
}

/// What a manifest names is used by its sources, the tests among them, or is there for a feature alone.
#[test]
fn every_dependency_is_used() {
    const FOR_A_FEATURE: &[&str] = &["ratatui-core"];
    let (support, own): (Vec<_>, Vec<_>) =
        files(&["src", "tests", "examples"]).into_iter().partition(|(path, _)| path.starts_with("tests/support"));
    let mut sources: BTreeMap<&Path, String> = BTreeMap::new();
    for (path, text) in &own {
        sources.entry(package(path)).or_default().push_str(text);
    }
    let mut unused = Vec::new();
    for (package, mut text) in sources {
        // Files for several packages are included by `#[path]`; those of the program have all of them.
        let included = |path: &Path| text.contains(&format!("support/{}", path.file_name().unwrap().display()));
        let support = support.iter().filter(|(path, _)| package == Path::new("") || included(path));
        let support: String = support.map(|(_, text)| text.as_str()).collect();
        text.push_str(&support);
        let words: BTreeSet<&str> = text.split(|c: char| !c.is_alphanumeric() && c != '_').collect();
        let manifest = toml(package.join("Cargo.toml"));
        let tables =
            ["dependencies", "dev-dependencies"].into_iter().filter_map(|table| manifest.get(table)?.as_table());
        let names = tables.flat_map(|table| table.keys()).filter(|name| !FOR_A_FEATURE.contains(&name.as_str()));
        unused.extend(
            names
                .filter(|name| !words.contains(&*name.replace('-', "_")))
                .map(|name| (package.to_owned(), name.clone())),
        );
    }
    assert!(unused.is_empty(), "named by a Cargo.toml and by no source: {unused:?}");
}

/// A variable that a build script gives reaches its own package alone, and without one `option_env!` is silently nothing.
#[test]
fn what_is_read_at_compile_time_is_given_by_the_build_of_the_same_package() {
    let mut found = 0;
    for (path, text) in files(&["src"]) {
        for (_, rest) in text.match_indices("env!(\"RAPID_").map(|(at, _)| text[at..].split_at("env!(\"".len())) {
            let name = rest.split('"').next().unwrap();
            let script = fs::read_to_string(root().join(package(&path)).join("build.rs")).unwrap_or_default();
            assert!(script.contains(&format!("{name}=")), "{}: {name} is not given by its build.rs", path.display());
            found += 1;
        }
    }
    assert!(found > 2, "{found}");
}

/// `rapid-remote` is in no workspace of this repository, and its lock is not written by a build of it.
#[test]
fn the_lock_of_rapid_remote_has_what_every_program_needs() {
    let (manifest, lock) = (toml("Cargo.toml"), toml("examples/remote/Cargo.lock"));
    let packages = lock["package"].as_array().unwrap();
    let own = packages.iter().find(|package| package["name"].as_str() == Some("rapid")).unwrap();
    let locked: BTreeSet<&str> =
        own["dependencies"].as_array().unwrap().iter().filter_map(|name| name.as_str()?.split(' ').next()).collect();
    let is_needed = |value: &toml::Value| value.get("optional").is_none();
    let needed = manifest["dependencies"].as_table().unwrap().iter().filter(|(_, value)| is_needed(value));
    let missing: Vec<_> = needed.map(|(name, _)| name).filter(|name| !locked.contains(name.as_str())).collect();
    assert!(
        missing.is_empty(),
        "{missing:?}: run `cargo update --workspace --manifest-path examples/remote/Cargo.toml`"
    );
}

/// Tests in documentation are not compiled (`doctest = false`): an example in Rust belongs to `examples/`, or is a test.
#[test]
fn no_comment_has_an_example_in_rust() {
    let files = files(&["src", "tests", "examples"]);
    let found: Vec<_> = files.iter().flat_map(|(path, text)| examples(text).map(move |line| (path, line))).collect();
    assert!(found.is_empty(), "examples that nothing compiles: {found:#?}");
}

/// The lines at which an example in Rust begins, in the documentation of a file.
fn examples(text: &str) -> impl Iterator<Item = usize> {
    let fences = text.lines().enumerate().filter_map(|(at, line)| {
        let line = line.trim_start();
        let comment = line.strip_prefix("///").or_else(|| line.strip_prefix("//!"))?;
        Some((at + 1, comment.trim().strip_prefix("```")?))
    });
    // Every second one is an end.
    fences.step_by(2).filter(|(_, language)| !["text", "toml", "mermaid"].contains(language)).map(|(line, _)| line)
}

/// A test that the harness leaves out would be missed by no one: whatever is left out is a part of another test, which runs
/// it in a process of its own, or is run by `make test-all`.
#[test]
fn a_test_that_is_ignored_is_run_by_another_one() {
    let files = files(&["src", "tests", "examples"]);
    let nightly = fs::read_to_string(root().join("scripts/tests-all.sh")).unwrap();
    let is_nightly = |path: &Path, reason: &str| reason == "run by make test-all" && runs_ignored(&nightly, path);
    let hidden = files.iter().flat_map(|(path, text)| hidden(text).map(move |reason| (path, reason)));
    let hidden: Vec<_> = hidden.filter(|(path, reason)| !is_nightly(path, reason)).collect();
    assert!(hidden.is_empty(), "ignored, and not with the reason `run by NAME` of a test of that file: {hidden:#?}");
}

/// Whether this script runs what the test program with this file ignores.
fn runs_ignored(script: &str, file: &Path) -> bool {
    // src/world/touch.rs, tests/program/x.rs, tests/bench/tests/smoke.rs, tests/vbench/tests/guest/endurance.rs
    let parts: Vec<String> = file.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    let program = parts.iter().rposition(|part| part == "tests").and_then(|last| parts.get(last + 1));
    let program = program.filter(|_| parts.iter().all(|part| part != "src"));
    script.lines().filter(|line| line.contains("--ignored")).any(|line| match program {
        Some(program) => line.contains(&format!("--test {program} ")),
        None => line.contains("--lib ") && parts.last().is_some_and(|module| line.ends_with(&format!(" {module}::"))),
    })
}

/// The reasons of tests in a file that are ignored and that no other test of it runs.
fn hidden(text: &str) -> impl Iterator<Item = String> {
    let mut reasons = Vec::new();
    ignored(TokenStream::from_str(text).unwrap_or_else(|error| panic!("{error}")), &mut reasons);
    reasons.into_iter().filter(move |reason| {
        let runner = reason.strip_prefix("run by ").filter(|name| text.contains(&format!("fn {name}()")));
        runner.is_none() || !text.contains("\"--ignored\"")
    })
}

/// The reasons of all `#[ignore]`; of one without a reason, or that depends on something, the attribute.
fn ignored(tokens: TokenStream, reasons: &mut Vec<String>) {
    let tokens = trees(tokens);
    for (at, token) in tokens.iter().enumerate() {
        let TokenTree::Group(group) = token else { continue };
        let attribute = trees(group.stream());
        let is_attribute = at > 0 && is_punct(tokens.get(at - 1), '#') && group.delimiter() == Delimiter::Bracket;
        let text = group.stream().to_string();
        if !is_attribute {
            ignored(group.stream(), reasons);
        } else if let [TokenTree::Ident(word), TokenTree::Punct(_), TokenTree::Literal(reason)] = &attribute[..]
            && word == "ignore"
        {
            reasons.push(reason.to_string().trim_matches('"').to_owned());
        } else if text == "ignore" || text.starts_with("cfg_attr") && text.contains("ignore") {
            reasons.push(text);
        }
    }
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn toml(path: impl AsRef<Path>) -> toml::Table {
    fs::read_to_string(root().join(path)).unwrap().parse().unwrap()
}

/// The folder with the manifest of a file; "" for the program's own.
fn package(file: &Path) -> &Path {
    file.ancestors().skip(1).find(|folder| root().join(folder).join("Cargo.toml").exists()).unwrap()
}

/// Every `.rs` file below these folders, by its path.
fn files(folders: &[&str]) -> BTreeMap<PathBuf, String> {
    let mut files = BTreeMap::new();
    let mut folders: Vec<PathBuf> = folders.iter().map(PathBuf::from).collect();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(root().join(&folder)).unwrap() {
            let path = folder.join(entry.unwrap().file_name());
            if root().join(&path).is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let text = fs::read_to_string(root().join(&path)).unwrap();
                files.insert(path, text);
            }
        }
    }
    files
}

/// What breaks a rule in files of src/, as `file:line: rule`. A crate has no layers: its manifest says what it sees.
fn violations(files: &BTreeMap<PathBuf, String>, is_of_crate: impl Fn(&Path) -> bool) -> Vec<String> {
    let sources: Vec<_> = files.iter().map(|(path, text)| (path, Source::read(path, text))).collect();
    let tests: Vec<_> = sources.iter().flat_map(|(_, source)| &source.tests).collect();
    let mut found = Vec::new();
    for (path, source) in &sources {
        if tests.iter().any(|test| source.module.starts_with(test)) {
            continue;
        }
        let mut rules = source.edges();
        if !is_of_crate(path) {
            rules.append(&mut source.layers());
        }
        rules.sort();
        rules.dedup();
        found.extend(rules.into_iter().map(|(line, rule)| format!("{}:{line}: {rule}", path.display())));
    }
    found
}

/// What the rules need to know of one file.
struct Source {
    /// `src/rig/stream.rs` is `["rig", "stream"]`, `src/lib.rs` is `[]`.
    module: Vec<String>,
    /// Every word, with its line.
    words: BTreeSet<(usize, String)>,
    /// Every path of several words, and all that is imported. One of our own begins with `crate` and the module.
    paths: BTreeSet<(usize, Vec<String>)>,
    /// Modules in files of their own that exist only in tests.
    tests: Vec<Vec<String>>,
}

impl Source {
    fn read(file: &Path, text: &str) -> Self {
        let module = file.with_extension("");
        let mut module: Vec<String> = module.iter().skip(1).map(|part| part.to_string_lossy().into_owned()).collect();
        module.pop_if(|name| name == "mod" || name == "lib");
        let tokens = TokenStream::from_str(text).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        let mut source =
            Self { module: module.clone(), words: BTreeSet::new(), paths: BTreeSet::new(), tests: Vec::new() };
        source.walk(&trees(tokens), &module, None);
        source
    }

    /// Reads tokens in `module`. `prefix`: they are imports, and this precedes them.
    fn walk(&mut self, tokens: &[TokenTree], module: &[String], prefix: Option<&[String]>) {
        use TokenTree::{Group, Ident, Punct};
        let child = |name: &proc_macro2::Ident| [module, &[name.to_string()]].concat();
        let mut rest = tokens;
        while !rest.is_empty() {
            let taken = match rest {
                [Punct(hash), Group(attribute), item @ ..] if hash.as_char() == '#' && is_test(attribute) => {
                    let end = item.iter().position(is_end).map_or(0, |at| at + 1);
                    if let [.., Ident(word), Ident(name), Punct(_)] = &item[..end]
                        && word == "mod"
                    {
                        self.tests.push(child(name));
                    }
                    2 + end
                }
                [Ident(word), Ident(name), Group(body), ..] if word == "mod" => {
                    self.walk(&trees(body.stream()), &child(name), None);
                    3
                }
                // Not `impl Trait + use<'a>`.
                [Ident(word), next, imports @ ..] if word == "use" && !is_punct(Some(next), '<') => {
                    let end = imports.iter().position(is_end_of_import).unwrap_or(imports.len());
                    self.walk(&rest[1..2 + end], module, Some(&[]));
                    2 + end
                }
                // Its other name is none of a module's.
                [Ident(word), Ident(_), ..] if word == "as" && prefix.is_some() => 2,
                [Ident(_), ..] => self.path(rest, module, prefix),
                [Group(group), ..] => {
                    self.walk(&trees(group.stream()), module, prefix);
                    1
                }
                _ => 1,
            };
            rest = &rest[taken..];
        }
    }

    /// Reads the path with which these tokens begin, and what is imported from it in braces. Returns its length.
    fn path(&mut self, tokens: &[TokenTree], module: &[String], prefix: Option<&[String]>) -> usize {
        let line = tokens[0].span().start().line;
        let mut path = prefix.unwrap_or_default().to_vec();
        let mut at = 0;
        loop {
            match tokens.get(at) {
                Some(TokenTree::Ident(word)) => {
                    self.words.insert((word.span().start().line, word.to_string()));
                    path.push(word.to_string());
                    at += 1;
                }
                Some(TokenTree::Group(group)) if group.delimiter() == Delimiter::Brace => {
                    self.walk(&trees(group.stream()), module, Some(&path));
                    return at + 1;
                }
                _ => break,
            }
            if !(is_punct(tokens.get(at), ':') && is_punct(tokens.get(at + 1), ':')) {
                break;
            }
            at += 2;
        }
        if prefix.is_some() || path.len() > 1 {
            self.paths.insert((line, resolved(path, module)));
        }
        at
    }

    /// `unsafe` and locks outside their homes.
    fn edges(&self) -> Vec<(usize, String)> {
        let place = self.module.join("/");
        let mut rules = Vec::new();
        for (line, word) in &self.words {
            if word == "unsafe" && !UNSAFE_HOMES.iter().any(|home| is_within(&place, home)) {
                rules.push((*line, format!("`unsafe` outside {}", UNSAFE_HOMES.join("/ and ") + "/")));
            }
            if LOCKS.contains(&word.as_str()) && !LOCK_HOMES.iter().any(|(home, _)| is_within(&place, home)) {
                rules
                    .push((*line, format!("`{word}`: nothing between a device and the file waits for another thread")));
            }
        }
        rules
    }

    /// Imports that do not point down, and crates outside their homes.
    fn layers(&self) -> Vec<(usize, String)> {
        // The crate's root only declares modules and gives names.
        let Some(home) = self.module.first() else { return Vec::new() };
        if layer(home).is_none() {
            return vec![(1, format!("module `{home}` has no layer: give it one in LAYERS"))];
        }
        let place = self.module.join("/");
        let rule = |path: &[String]| import(home, path).or_else(|| third_party(&place, path));
        self.paths.iter().filter_map(|(line, path)| Some((*line, rule(path)?))).collect()
    }
}

/// A path in `module`, with `crate`, `self` and `super` as `crate`. main.rs sees the library by name.
fn resolved(path: Vec<String>, module: &[String]) -> Vec<String> {
    let (mut base, mut rest) = match path[0].as_str() {
        "crate" | "rapid" => (&[][..], &path[1..]),
        "self" => (module, &path[1..]),
        "super" => (module, &path[..]),
        _ => return path,
    };
    while let Some(tail) = rest.strip_prefix(&["super".to_owned()]) {
        (base, rest) = (&base[..base.len().saturating_sub(1)], tail);
    }
    [&["crate".to_owned()], base, rest].concat()
}

fn trees(stream: TokenStream) -> Vec<TokenTree> {
    stream.into_iter().collect()
}

fn is_test(attribute: &proc_macro2::Group) -> bool {
    attribute.stream().to_string().replace(' ', "") == "cfg(test)"
}

/// Where an item ends: with `;` or its body.
fn is_end(token: &TokenTree) -> bool {
    is_end_of_import(token) || matches!(token, TokenTree::Group(group) if group.delimiter() == Delimiter::Brace)
}

fn is_end_of_import(token: &TokenTree) -> bool {
    is_punct(Some(token), ';')
}

fn is_punct(token: Option<&TokenTree>, wanted: char) -> bool {
    matches!(token, Some(TokenTree::Punct(punct)) if punct.as_char() == wanted)
}

fn layer(module: &str) -> Option<usize> {
    LAYERS.iter().position(|layer| layer.contains(&module))
}

/// What is wrong with `home` naming `path`.
fn import(home: &str, path: &[String]) -> Option<String> {
    let [root, target, ..] = path else { return None };
    // Names that are not modules are the crate's own re-exports.
    let (from, to) = (layer(home)?, layer(target)?);
    if root != "crate" || target == home || to < from {
        return None;
    }
    let edge = format!("`{home}` (layer {from}) imports `{target}` (layer {to})");
    if to > from {
        return Some(format!("{edge}: imports point down only"));
    }
    let sideways = SIDEWAYS.iter().any(|(module, seen)| *module == home && seen.contains(&target.as_str()));
    (!sideways).then(|| format!("{edge}: modules of this layer do not import one another"))
}

/// What is wrong with the file at `place` naming the crate with which `path` begins.
fn third_party(place: &str, path: &[String]) -> Option<String> {
    let (name, homes) = HOMES.iter().find(|(name, _)| *name == path[0])?;
    let is_at_home = homes.iter().any(|home| is_within(place, home));
    (!is_at_home).then(|| format!("crate `{name}` is used outside its home: {}", homes.join(", ")))
}

fn is_within(place: &str, module: &str) -> bool {
    place.strip_prefix(module).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

mod the_check_itself {
    use super::*;

    /// The violations of files of the program, as `line: rule`.
    fn found(files: &[(&str, &str)]) -> Vec<String> {
        let files = files.iter().map(|(path, text)| (Path::new("src").join(path), (*text).to_owned())).collect();
        let is_of_crate = |path: &Path| path.starts_with("src/core") || path.starts_with("src/policy");
        violations(&files, is_of_crate).iter().map(|found| found.split_once(':').unwrap().1.to_owned()).collect()
    }

    #[track_caller]
    fn finds(file: &str, text: &str, expected: &[&str]) {
        let found = found(&[(file, text)]);
        assert_eq!(found.len(), expected.len(), "{file}: found {found:#?}, expected {expected:#?}");
        for (found, expected) in found.iter().zip(expected) {
            assert!(found.starts_with(expected), "{file}: found {found:?}, expected {expected:?}");
        }
    }

    #[test]
    fn imports_upwards_and_sideways_are_found() {
        finds("orders.rs", "use rapid_core::modality::ModalityId;", &[]);
        finds("orders.rs", "use crate::rig::Rig;", &["1: `orders` (layer 0) imports `rig` (layer 1): imp"]);
        finds("rig/mod.rs", "use crate::app::Options;", &["1: `rig` (layer 1) imports `app` (layer 2): imp"]);
        finds("rig/stream.rs", "\n\nuse crate::session::Journal;", &["3: `rig` (layer 1) imports `session`"]);
        finds("dispatch/mod.rs", "use crate::cli::Cli;", &[]);
        finds("cli/mod.rs", "use crate::dispatch::run;", &["1: `cli` (layer 3) imports `dispatch`"]);
        finds("app.rs", "use crate::{rig, session};", &[]);
    }

    #[test]
    fn every_way_to_write_a_path_is_seen() {
        let nested = "use crate::{\n    time::Stamp,\n    rig::{\n        Rig,\n        core as other,\n    },\n};";
        finds("orders.rs", nested, &["4: `orders` (layer 0) imports `rig`", "5: `orders` (layer 0) imports `rig`"]);
        finds("orders.rs", "fn f() { let b = crate::rig::Rig::new(); }", &["1: `orders`"]);
        finds("orders.rs", "type A = Vec<crate::rig::Rig>;", &["1: `orders`"]);
        finds("orders.rs", "fn f() { select! { _ = async { crate::rig::run().await } => {} } }", &["1: `orders`"]);
        finds("orders.rs", "use super::rig::Rig;", &["1: `orders`"]);
        finds("rig/stream.rs", "use super::super::session::Journal;", &["1: `rig`"]);
        finds("rig/stream.rs", "use super::core::Core; use self::inner::X;", &[]);
        finds("rig/mod.rs", "mod inner { fn f() { super::super::session::open() } }", &["1: `rig`"]);
        finds("orders.rs", "pub use crate::rig::*;", &["1: `orders`"]);
        finds("main.rs", "use rapid::app; fn f() { rapid::commands::run() }", &[]);
    }

    #[test]
    fn comments_strings_and_tests_do_not_count() {
        finds(
            "orders.rs",
            "// use crate::rig::Rig;\n/// [`crate::rig::Rig`]\nconst A: &str = \"crate::rig::Rig unsafe\";",
            &[],
        );
        finds("orders.rs", "#[cfg(test)]\nmod tests {\n use crate::rig::Rig;\n fn f() { println!() }\n}", &[]);
        finds("orders.rs", "#[cfg(not(test))]\nmod x { use crate::rig::Rig; }", &["2: `orders`"]);
        finds("alignment.rs", "struct A {\n #[cfg(test)]\n a: u8,\n b: Mutex<u8>,\n}", &["4: `Mutex`"]);
        finds("alignment.rs", "enum A { #[cfg(test)] B, C(Mutex<u8>) }", &["1: `Mutex`"]);
        let files = [("orders/give.rs", "#[cfg(test)]\nmod tests;"), ("orders/give/tests.rs", "use crate::rig::Rig;")];
        assert_eq!(found(&files), [] as [&str; 0]);
    }

    #[test]
    fn a_crate_outside_its_home_is_found() {
        finds("commands/policy.rs", "use zip::ZipArchive;", &[]);
        finds("commands/check.rs", "fn f() -> ::zip::Archive {}", &["1: crate `zip`"]);
        finds("commands/check.rs", "fn f(n: u8) { n as zip::Level; a.zip(b); }", &["1: crate `zip`"]);
        finds("commands/check.rs", "use zip as archive;", &["1: crate `zip`"]);
        finds("commands/check.rs", "use {zip as archive};", &["1: crate `zip`"]);
        finds("commands/check.rs", "use ::zip;", &["1: crate `zip`"]);
        finds("commands/check.rs", "use archive as zip;", &[]);
        finds("commands/check.rs", "fn f() -> impl Future<Output = ()> + use<'_> { zip::c() }", &["1: crate `zip`"]);
        finds(
            "commands/check.rs",
            "fn f(d: &::zip::Archive) {}",
            &["1: crate `zip` is used outside its home: commands/policy"],
        );
        finds("commands/progress/bar.rs", "use indicatif::ProgressBar;", &[]);
        finds("commands/progresses.rs", "use indicatif::ProgressBar;", &["1: crate `indicatif`"]);
        finds("rig/mod.rs", "use {toml::Table, std::io};", &["1: crate `toml`"]);
        finds("orders.rs", "use tokio::sync::watch;", &[]);
    }

    #[test]
    fn examples_are_found() {
        let text = "//! ```text\n//! a\n//! ```\nfn f() {}\n/// ```\n/// f();\n/// ```\n/// ```rust\n/// ```\n// ```\n";
        assert_eq!(examples(text).collect::<Vec<_>>(), [5, 8]);
        assert_eq!(examples("/// ```toml\n/// ```\n").count(), 0);
    }

    #[test]
    fn ignored_tests_are_found() {
        let found = |attribute: &str, runner: &str| {
            let text =
                format!("mod tests {{ #[test]\n{attribute}\nfn a() {{}}\n#[test]\nfn b() {{ run({runner}); }} }}");
            hidden(&text).collect::<Vec<_>>()
        };
        let runner = "\"--ignored\"";
        assert_eq!(found("#[ignore = \"run by b\"]", runner), [] as [&str; 0]);
        assert_eq!(found("#[ignore = \"run by b\"]", ""), ["run by b"]);
        assert_eq!(found("#[ignore = \"run by c\"]", runner), ["run by c"]);
        assert_eq!(found("#[ignore = \"slow\"]", runner), ["slow"]);
        assert_eq!(found("#[ignore]", runner), ["ignore"]);
        assert_eq!(found("#[cfg_attr(debug_assertions, ignore)]", runner).len(), 1);
        assert_eq!(found("// #[ignore]", runner), [] as [&str; 0]);
    }

    #[test]
    fn unsafe_and_locks_are_found() {
        finds("policy/onnxruntime/loader.rs", "fn f() { unsafe { g() } }", &[]);
        finds("policy/onnxruntime.rs", "fn f() { unsafe { g() } }", &["1: `unsafe`"]);
        finds("rig/mod.rs", "fn f() {\n unsafe { g() } }", &["2: `unsafe` outside devices/driver/ and"]);
        finds("rig/worker.rs", "use std::sync::{Arc, Mutex};", &[]);
        finds("rig/stream.rs", "use std::sync::{Arc, Mutex};", &["1: `Mutex`"]);
        finds("alignment.rs", "struct A(std::sync::RwLock<u8>);", &["1: `RwLock`"]);
        finds("core/mask.rs", "use std::sync::Mutex; use crate::rig::Rig;", &["1: `Mutex`"]);
        finds("core/mask.rs", "fn f() { unsafe { g() } }", &["1: `unsafe`"]);
        finds("utils.rs", "", &["1: module `utils` has no layer"]);
    }
}
