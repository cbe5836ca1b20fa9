//! The architecture as data, and a check that the sources keep to it.
//!
//! Modules lie in layers and import downwards only. Every third-party crate has one home. `unsafe`
//! lives at the edge, locks off the path of a sample. A file is as long as its subject: 400 lines are a
//! guide, a function that does not fit on a screen (`too-many-lines-threshold` in clippy.toml) is the rule.
//!
//! What is read are tokens, not text: comments and strings do not count, macros do. Items under
//! `#[cfg(test)]` are left out: a test may build its subject from whatever it likes.
//!
//! A folder of src/ with a manifest is a crate: what it may see is said there, and the compiler keeps it to that.
//!
//! A new module gets a line in [`LAYERS`], a new dependency one in [`HOMES`]; if a change needs more
//! than that to pass, the change is what is wrong.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs;
use std::io;
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
    ("rig/hooks", "the hooks of an entry run one after the other"),
    ("rig/worker", "a program waits for the end of the one before"),
    (
        "registry/simulation",
        "the simulated world, which its devices share, and a light that is switched for a calibration",
    ),
    ("policy/onnxruntime", "onnxruntime is loaded once, before the first chunk"),
    ("system/fault", "tests"),
    ("system/panics", "messages of panics"),
    ("screens/tui", "the monitor's terminal"),
];

/// Macros that write where a screen may be.
const PRINTING: &[&str] = &["print", "println", "eprint", "eprintln", "dbg"];

#[test]
fn the_sources_follow_the_architecture() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = BTreeMap::new();
    collect(&root, &root, &mut files).unwrap();
    // A folder with a manifest is a crate of its own: what it may see is in that.
    let is_of_crate = |path: &Path| {
        path.ancestors().skip(1).any(|folder| folder != Path::new("") && root.join(folder).join("Cargo.toml").exists())
    };
    let of_crates = files.extract_if(.., |path, _| is_of_crate(path)).collect();
    assert!(files.contains_key(Path::new("lib.rs")), "no src/lib.rs under {}", root.display());

    let mut violations = check_tree(&files, check);
    violations.extend(check_tree(&of_crates, check_crate));
    let list: Vec<String> = violations.iter().map(ToString::to_string).collect();
    assert!(list.is_empty(), "{} violations of the table in tests/layering.rs:\n{}", list.len(), list.join("\n"));
}

#[test]
fn every_dependency_has_a_home() {
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
    let manifest: toml::Table = fs::read_to_string(manifest).unwrap().parse().unwrap();
    let dependencies = manifest["dependencies"].as_table().unwrap();
    // What a crate of this workspace may see is said in its manifest.
    let has_home = |name: &str| {
        name.starts_with("rapid_") || ANYWHERE.contains(&name) || HOMES.iter().any(|(home, _)| *home == name)
    };
    let homeless: Vec<_> = dependencies.keys().filter(|name| !has_home(&name.replace('-', "_"))).collect();
    assert!(homeless.is_empty(), "Cargo.toml depends on {homeless:?}: name their homes in HOMES");
}

/// What a manifest names is used by its sources, the tests among them, or is there for a feature alone.
#[test]
fn every_dependency_is_used() {
    const FOR_A_FEATURE: &[&str] = &["ratatui-core"];
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = BTreeMap::new();
    for folder in ["src", "tests", "examples"] {
        collect(root, &root.join(folder), &mut files).unwrap();
    }
    let is_package = |folder: &&Path| root.join(folder).join("Cargo.toml").exists();
    let (shared, own): (Vec<_>, Vec<_>) = files.iter().partition(|(path, _)| path.starts_with("tests/support"));
    let mut sources: BTreeMap<&Path, String> = BTreeMap::new();
    for (path, text) in own {
        let package = path.ancestors().skip(1).find(is_package).unwrap();
        sources.entry(package).or_default().push_str(text);
    }
    for (package, sources) in &mut sources {
        // Included by `#[path]`.
        let includes = |path: &Path| sources.contains(&format!("support/{}", path.file_name().unwrap().display()));
        let support = shared.iter().filter(|(path, _)| *package == Path::new("") || includes(path));
        let support: String = support.map(|(_, text)| text.as_str()).collect();
        sources.push_str(&support);
    }
    let is_named = |sources: &str, name: &str| {
        let word = name.replace('-', "_");
        FOR_A_FEATURE.contains(&name)
            || sources.split(|c: char| !c.is_alphanumeric() && c != '_').any(|other| other == word)
    };
    let dependencies = |package: &Path| -> Vec<String> {
        let manifest: toml::Table = fs::read_to_string(root.join(package).join("Cargo.toml")).unwrap().parse().unwrap();
        let tables =
            ["dependencies", "dev-dependencies"].into_iter().filter_map(|table| manifest.get(table)?.as_table());
        tables.flat_map(|table| table.keys().cloned()).collect()
    };
    let unused: Vec<_> = sources
        .iter()
        .flat_map(|(package, sources)| dependencies(package).into_iter().map(move |name| (package, sources, name)))
        .filter(|(_, sources, name)| !is_named(sources, name))
        .map(|(package, _, name)| (package, name))
        .collect();
    assert!(unused.is_empty(), "named by a Cargo.toml and by no source: {unused:?}");
}

/// A variable that a build script gives reaches its own package alone, and without one `option_env!` is silently nothing.
#[test]
fn what_is_read_at_compile_time_is_given_by_the_build_of_the_same_package() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = BTreeMap::new();
    collect(root, &root.join("src"), &mut files).unwrap();
    let is_package = |folder: &&Path| root.join(folder).join("Cargo.toml").exists();
    let mut found = 0;
    for (path, text) in files {
        let package = path.ancestors().skip(1).find(is_package).unwrap();
        for (_, rest) in text.match_indices("env!(\"RAPID_").map(|(at, _)| text[at..].split_at("env!(\"".len())) {
            let name = rest.split('"').next().unwrap();
            let script = fs::read_to_string(root.join(package).join("build.rs")).unwrap_or_default();
            assert!(script.contains(&format!("{name}=")), "{}: {name} is not given by its build.rs", path.display());
            found += 1;
        }
    }
    assert!(found > 2, "{found}");
}

/// `rapid-remote` is in no workspace of this repository, and its lock is not written by a build of it.
#[test]
fn the_lock_of_rapid_remote_has_what_every_program_needs() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let read = |path: &str| -> toml::Table { fs::read_to_string(root.join(path)).unwrap().parse().unwrap() };
    let (manifest, lock) = (read("Cargo.toml"), read("examples/remote/Cargo.lock"));
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
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = BTreeMap::new();
    for folder in ["src", "tests", "examples"] {
        collect(root, &root.join(folder), &mut files).unwrap();
    }
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
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = BTreeMap::new();
    for folder in ["src", "tests", "examples"] {
        collect(root, &root.join(folder), &mut files).unwrap();
    }
    let nightly = fs::read_to_string(root.join("scripts/tests-all.sh")).unwrap();
    let is_nightly = |path: &Path, reason: &str| reason == "run by make test-all" && runs_ignored(&nightly, path);
    let hidden: Vec<_> = files.iter().flat_map(|(path, text)| hidden(text).map(move |reason| (path, reason))).collect();
    let hidden: Vec<_> = hidden.into_iter().filter(|(path, reason)| !is_nightly(path, reason)).collect();
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
    let tokens: Vec<TokenTree> = tokens.into_iter().collect();
    for (at, token) in tokens.iter().enumerate() {
        let TokenTree::Group(group) = token else { continue };
        let attribute: Vec<TokenTree> = group.stream().into_iter().collect();
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

/// Something that breaks a rule, and which.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Violation {
    file: PathBuf,
    line: usize,
    rule: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "src/{}:{}: {}", self.file.display(), self.line, self.rule)
    }
}

/// Every `.rs` file below `dir`, by its path from `root`.
fn collect(root: &Path, dir: &Path, files: &mut BTreeMap<PathBuf, String>) -> io::Result<()> {
    for entry in fs::read_dir(dir)? {
        let path = entry?.path();
        if path.is_dir() {
            collect(root, &path, files)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs::read_to_string(&path)?;
            files.insert(path.strip_prefix(root).unwrap_or(&path).to_owned(), text);
        }
    }
    Ok(())
}

fn check_tree(files: &BTreeMap<PathBuf, String>, check: fn(&Source) -> Vec<Violation>) -> Vec<Violation> {
    let read: Vec<Source> = files.iter().map(|(path, text)| Source::read(path, text)).collect();
    let tests: BTreeSet<&Vec<String>> = read.iter().flat_map(|source| &source.test_modules).collect();
    let mut violations: Vec<Violation> = read
        .iter()
        .filter(|source| !tests.iter().any(|test| source.module.starts_with(test)))
        .flat_map(check)
        .collect();
    violations.sort();
    violations.dedup();
    violations
}

/// What the rules need to know of one file.
struct Source {
    file: PathBuf,
    /// `driver/camera.rs` is `["driver", "camera"]`, `lib.rs` is `[]`.
    module: Vec<String>,
    /// Paths named, with `crate`, `self` and `super` resolved to `crate`.
    paths: Vec<(usize, Vec<String>)>,
    /// Lines with the word `unsafe`.
    unsafe_lines: Vec<usize>,
    /// Lines with a macro that prints, and its name.
    prints: Vec<(usize, String)>,
    /// Modules declared, at the top level of the file.
    declared: BTreeSet<String>,
    /// Modules in files of their own that exist only in tests.
    test_modules: Vec<Vec<String>>,
}

impl Source {
    fn read(file: &Path, text: &str) -> Self {
        let mut module: Vec<String> = file.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        let name = module.pop().unwrap_or_default();
        match name.trim_end_matches(".rs") {
            "mod" | "lib" => {}
            stem => module.push(stem.to_owned()),
        }
        let mut source = Self {
            file: file.to_owned(),
            module: module.clone(),
            paths: Vec::new(),
            unsafe_lines: Vec::new(),
            prints: Vec::new(),
            declared: BTreeSet::new(),
            test_modules: Vec::new(),
        };
        let tokens = TokenStream::from_str(text).unwrap_or_else(|error| panic!("src/{}: {error}", file.display()));
        // main.rs is a crate of its own that sees the library by name.
        if module == ["main"] {
            module.clear();
        }
        source.walk(tokens, &module);
        source
    }

    fn walk(&mut self, tokens: TokenStream, module: &[String]) {
        let tokens: Vec<TokenTree> = tokens.into_iter().collect();
        let mut at = 0;
        while let Some(token) = tokens.get(at) {
            if let Some(end) = cfg_test_item(&tokens, at) {
                self.leave_out(&tokens[at..end], module);
                at = end;
                continue;
            }
            at = match token {
                TokenTree::Group(group) => {
                    self.walk(group.stream(), module);
                    at + 1
                }
                TokenTree::Ident(word) => self.word(&word.to_string(), &tokens, at, module),
                _ => at + 1,
            };
        }
    }

    /// Reads what begins with the word at `at`; returns where to continue.
    fn word(&mut self, word: &str, tokens: &[TokenTree], at: usize, module: &[String]) -> usize {
        let line = tokens[at].span().start().line;
        match word {
            "unsafe" => self.unsafe_lines.push(line),
            "mod" => return self.mod_item(&tokens[at + 1..], module).map_or(at + 1, |taken| at + 1 + taken),
            // Not `impl Trait + use<'a>`.
            "use" if !is_punct(tokens.get(at + 1), '<') => {
                let end = tokens[at..].iter().position(|t| is_punct(Some(t), ';')).map_or(tokens.len(), |n| at + n);
                self.tree(&tokens[at + 1..end], &[], module);
                return end;
            }
            _ if PRINTING.contains(&word) && is_punct(tokens.get(at + 1), '!') => {
                self.prints.push((line, word.to_owned()));
            }
            _ if is_path_sep(tokens, at + 1) && !is_after_generics(tokens, at) => {
                return self.inline_path(tokens, at, module);
            }
            _ => {}
        }
        at + 1
    }

    /// What follows `mod`: a name, and the module's body if it is here. Returns how many tokens that was.
    fn mod_item(&mut self, rest: &[TokenTree], module: &[String]) -> Option<usize> {
        let TokenTree::Ident(name) = rest.first()? else { return None };
        if module == self.module {
            self.declared.insert(name.to_string());
        }
        let Some(TokenTree::Group(body)) = rest.get(1) else { return Some(1) };
        let inner: Vec<String> = module.iter().cloned().chain([name.to_string()]).collect();
        self.walk(body.stream(), &inner);
        Some(2)
    }

    /// A path in an expression or a type: `crate::status::Board::new`. Returns where it ends.
    fn inline_path(&mut self, tokens: &[TokenTree], start: usize, module: &[String]) -> usize {
        let line = tokens[start].span().start().line;
        let mut path = Vec::new();
        let mut at = start;
        while let Some(TokenTree::Ident(word)) = tokens.get(at) {
            path.push(word.to_string());
            at += 1;
            if !is_path_sep(tokens, at) {
                break;
            }
            at += 2;
        }
        self.name(line, &path, module);
        at
    }

    /// A tree of a `use`: commas, braces, `as`, `*`.
    fn tree(&mut self, tokens: &[TokenTree], prefix: &[String], module: &[String]) {
        for branch in tokens.split(|token| is_punct(Some(token), ',')) {
            let mut path = prefix.to_vec();
            let mut whole = true;
            let mut line = 0;
            for token in branch {
                line = if line == 0 { token.span().start().line } else { line };
                match token {
                    TokenTree::Ident(word) if word == "as" => break,
                    TokenTree::Ident(word) => path.push(word.to_string()),
                    TokenTree::Group(group) if group.delimiter() == Delimiter::Brace => {
                        let inner: Vec<TokenTree> = group.stream().into_iter().collect();
                        self.tree(&inner, &path, module);
                        whole = false;
                    }
                    _ => {}
                }
            }
            if whole && !branch.is_empty() {
                self.name(line, &path, module);
            }
        }
    }

    fn name(&mut self, line: usize, path: &[String], module: &[String]) {
        let mut base: Option<Vec<String>> = None;
        let mut rest = path;
        while let Some((first, tail)) = rest.split_first() {
            base = Some(match (first.as_str(), base) {
                ("crate", None) => Vec::new(),
                ("self", None) => module.to_vec(),
                ("super", known) => {
                    let mut up = known.unwrap_or_else(|| module.to_vec());
                    up.pop();
                    up
                }
                ("self", known @ Some(_)) => known.unwrap_or_default(),
                ("rapid", None) if self.module == ["main"] => Vec::new(),
                (_, known) => {
                    base = known;
                    break;
                }
            });
            rest = tail;
        }
        let resolved = match base {
            Some(base) => ["crate".to_owned()].into_iter().chain(base).chain(rest.iter().cloned()).collect(),
            None => path.to_vec(),
        };
        self.paths.push((line, resolved));
    }

    /// Does this file bring in a module of ours under this name?
    fn imports_module(&self, name: &str) -> bool {
        self.paths.iter().any(|(_, path)| {
            path.first().is_some_and(|root| root == "crate") && path.last().is_some_and(|last| last == name)
        })
    }

    fn violations(&self, rules: Vec<(usize, String)>) -> Vec<Violation> {
        rules.into_iter().map(|(line, rule)| Violation { file: self.file.clone(), line, rule }).collect()
    }

    fn leave_out(&mut self, item: &[TokenTree], module: &[String]) {
        if let [.., TokenTree::Ident(word), TokenTree::Ident(name), TokenTree::Punct(_)] = item
            && word == "mod"
        {
            self.test_modules.push(module.iter().cloned().chain([name.to_string()]).collect());
        }
    }
}

/// If `#[cfg(test)]` stands here, the end of the item it belongs to.
fn cfg_test_item(tokens: &[TokenTree], at: usize) -> Option<usize> {
    let (TokenTree::Punct(hash), TokenTree::Group(attribute)) = (tokens.get(at)?, tokens.get(at + 1)?) else {
        return None;
    };
    let text: String = attribute.stream().to_string().split_whitespace().collect();
    if hash.as_char() != '#' || text != "cfg(test)" {
        return None;
    }
    let end = tokens[at + 2..].iter().position(|token| match token {
        TokenTree::Punct(punct) => punct.as_char() == ';',
        TokenTree::Group(group) => group.delimiter() == Delimiter::Brace,
        _ => false,
    })?;
    Some(at + 2 + end + 1)
}

fn is_punct(token: Option<&TokenTree>, wanted: char) -> bool {
    matches!(token, Some(TokenTree::Punct(punct)) if punct.as_char() == wanted)
}

fn is_path_sep(tokens: &[TokenTree], at: usize) -> bool {
    is_punct(tokens.get(at), ':') && is_punct(tokens.get(at + 1), ':')
}

/// `Vec::<u8>::new`, `<T as Trait>::make`: what stands here belongs to a type, and is not a crate or module.
fn is_after_generics(tokens: &[TokenTree], at: usize) -> bool {
    let arrow = at >= 4 && is_punct(tokens.get(at - 4), '-');
    at >= 3 && is_path_sep(tokens, at - 2) && is_punct(tokens.get(at - 3), '>') && !arrow
}

/// What the manifest of a crate and its lints cannot say.
fn check_crate(source: &Source) -> Vec<Violation> {
    source.violations(edges(source))
}

/// `unsafe` and locks outside their homes.
fn edges(source: &Source) -> Vec<(usize, String)> {
    let place = source.module.join("/");
    let mut rules = Vec::new();
    if !UNSAFE_HOMES.iter().any(|allowed| is_within(&place, allowed)) {
        let rule = format!("`unsafe` outside {}", UNSAFE_HOMES.join("/ and ") + "/");
        rules.extend(source.unsafe_lines.iter().map(|line| (*line, rule.clone())));
    }
    if !LOCK_HOMES.iter().any(|(allowed, _)| is_within(&place, allowed)) {
        let lock = |path: &[String]| path.iter().find(|name| LOCKS.contains(&name.as_str())).cloned();
        let found = source.paths.iter().filter_map(|(line, path)| Some((*line, lock(path)?)));
        let waits = |lock| format!("`{lock}`: nothing between a device and the file waits for another thread");
        rules.extend(found.map(|(line, lock)| (line, waits(lock))));
    }
    rules
}

fn check(source: &Source) -> Vec<Violation> {
    let mut rules = edges(source);
    let place = source.module.join("/");
    let home = source.module.first().map(String::as_str);

    for (line, word) in &source.prints {
        rules.push((*line, format!("`{word}!`: write to a given `impl io::Write`")));
    }
    // The crate's root only declares modules and gives names.
    if let Some(home) = home {
        if layer(home).is_none() {
            rules.push((1, format!("module `{home}` has no layer: give it one in LAYERS")));
        } else {
            for (line, path) in &source.paths {
                rules.extend(import(home, path).map(|rule| (*line, rule)));
                rules.extend(third_party(source, &place, path).map(|rule| (*line, rule)));
            }
        }
    }
    source.violations(rules)
}

fn layer(module: &str) -> Option<usize> {
    LAYERS.iter().position(|layer| layer.contains(&module))
}

/// What is wrong with `home` naming `path`.
fn import(home: &str, path: &[String]) -> Option<String> {
    let [root, target, ..] = path else { return None };
    let target = target.as_str();
    // Names that are not modules are the crate's own re-exports.
    let (from, to) = (layer(home)?, layer(target)?);
    if root != "crate" || target == home {
        return None;
    }
    let edge = format!("`{home}` (layer {from}) imports `{target}` (layer {to})");
    if to > from {
        return Some(format!("{edge}: imports point down only"));
    }
    if to == from {
        let sideways = SIDEWAYS.iter().any(|(module, seen)| *module == home && seen.contains(&target));
        return (!sideways).then(|| format!("{edge}: modules of this layer do not import one another"));
    }
    None
}

/// What is wrong with the file at `place` naming the crate `path` begins with.
fn third_party(source: &Source, place: &str, path: &[String]) -> Option<String> {
    let name = path.first()?;
    // `mod zip;` in a file, `use crate::commands::zip;`: the name means the module there.
    if source.declared.contains(name) || source.imports_module(name) {
        return None;
    }
    let (_, homes) = HOMES.iter().find(|(dependency, _)| dependency == name)?;
    let is_at_home = homes.iter().any(|module| is_within(place, module));
    (!is_at_home).then(|| format!("crate `{name}` is used outside its home: {}", homes.join(", ")))
}

fn is_within(place: &str, module: &str) -> bool {
    place.strip_prefix(module).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

mod the_check_itself {
    use super::*;

    /// The violations of one file, as `line: rule`.
    fn found(file: &str, text: &str) -> Vec<String> {
        let files = BTreeMap::from([(PathBuf::from(file), text.to_owned())]);
        check_tree(&files, check).into_iter().map(|v| format!("{}: {}", v.line, v.rule)).collect()
    }

    #[track_caller]
    fn finds(file: &str, text: &str, expected: &[&str]) {
        let found = found(file, text);
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
        let files = BTreeMap::from([
            (PathBuf::from("orders/give.rs"), "#[cfg(test)]\nmod tests;".to_owned()),
            (PathBuf::from("orders/give/tests.rs"), "use crate::rig::Rig;".to_owned()),
        ]);
        assert_eq!(check_tree(&files, check), []);
    }

    #[test]
    fn a_crate_outside_its_home_is_found() {
        finds("commands/policy.rs", "use zip::ZipArchive;", &[]);
        finds("commands/mod.rs", "mod zip;\nfn f() { zip::read() }", &[]);
        finds("commands/check.rs", "fn f() -> ::zip::Archive { <A as B>::zip::c() }", &["1: crate `zip`"]);
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
    fn unsafe_prints_and_locks_are_found() {
        let files =
            BTreeMap::from([(PathBuf::from("policy/onnxruntime/loader.rs"), "fn f() { unsafe { g() } }".to_owned())]);
        assert_eq!(check_tree(&files, check_crate), []);
        finds("rig/mod.rs", "fn f() {\n unsafe { g() } }", &["2: `unsafe` outside devices/driver/ and"]);
        finds("rig/mod.rs", "fn f() { if a { println!(\"x\") } }", &["1: `println!`"]);
        finds("rig/worker.rs", "use std::sync::{Arc, Mutex};", &[]);
        finds("rig/stream.rs", "use std::sync::{Arc, Mutex};", &["1: `Mutex`"]);
        finds("alignment.rs", "struct A(std::sync::RwLock<u8>);", &["1: `RwLock`"]);
        let files = BTreeMap::from([(PathBuf::from("core/mask.rs"), "use std::sync::Mutex;".to_owned())]);
        assert_eq!(check_tree(&files, check_crate).len(), 1);
        let files = BTreeMap::from([(PathBuf::from("core/mask.rs"), "fn f() { unsafe { g() } }".to_owned())]);
        assert_eq!(check_tree(&files, check_crate).len(), 1);
        finds("utils.rs", "", &["1: module `utils` has no layer"]);
    }
}
