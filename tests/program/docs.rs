//! The documents are right: every fenced block of README.md, CONTRIBUTING.md and docs/ is run, parsed or found
//! in the program that it quotes, and every `rapid ...` and `make ...` in the text is understood.
//!
//! | block | what is done with it |
//! |---|---|
//! | `sh` | run by bash in a folder of the page's own, block after block, with the built program and the repository's registry |
//! | `sh not-run: REASON` | its commands are parsed; the block is listed in [`NOT_RUN`] |
//! | `toml registry` | merged into the repository's devices.toml, then read as a registry |
//! | `toml scenario` | read as a scenario for the repository's devices.toml |
//! | `json` | parsed, line by line |
//! | `c`, `python`, `rust` `file=PATH` | a part of that example, which a test of its own runs |
//! | `text`, `mermaid` | pictures; nothing is done |

#![allow(clippy::expect_used, reason = "what fails here fails a test")]

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use rapid::cli::Cli;
use rapid_registry::Registry;
use rapid_registry::scenario::Scenario;

use crate::support::{Place, executable, python};

/// Blocks that cannot be run in a test: the page and the first line of each.
const NOT_RUN: &[(&str, &str)] = &[
    (
        "CONTRIBUTING.md",
        "make quick                          # by habit: format, lints, unit tests, layering, the fast tests of the program",
    ),
    ("README.md", "cargo build --release --locked"),
    (
        "README.md",
        "make demo       # build, then the simulated rig: the monitor leads through an unplug, and a policy through another",
    ),
    ("README.md", "rapid devices                     # what is plugged in: vendor, product, serial number, port"),
    ("docs/benchmarks.md", "make bench                                  # everything, about 30 minutes"),
    ("docs/episodes.md", "sudo install -m 755 rapid /usr/local/bin/"),
    ("docs/export.md", "python=$(scripts/venv.sh venv-lerobot models/requirements-lerobot.txt --no-deps)"),
    ("docs/export.md", "python=$(scripts/venv.sh venv-fleet models/requirements-fleet.txt --no-deps)"),
    (
        "docs/fleet.md",
        "ray start --head                                        # on the first machine; on the others: ray start --address=FIRST:6379",
    ),
    (
        "docs/interfaces.md",
        "rapid --foxglove                            # on the rig; then in Foxglove: open connection, ws://localhost:8765",
    ),
    ("docs/interfaces.md", "rerun episodes/20261125_place-block_001.mcap"),
    (
        "docs/monitor.md",
        "rapid monitor                         # the monitor of a rapid that runs headless, as a service or in another terminal",
    ),
    (
        "docs/network.md",
        "cargo build --release --locked --manifest-path examples/remote/Cargo.toml    # on both; the program is in examples/remote/target",
    ),
    (
        "docs/network.md",
        "rapid-remote serve --listen tcp/127.0.0.1:7447                         # on B: only through SSH",
    ),
    (
        "docs/policies.md",
        "make train                                              # models/tactile-id, from 240 handheld demonstrations",
    ),
    (
        "docs/policies.md",
        "rapid --infer POLICY --wait                   # starts when what the policy requires is plugged in",
    ),
    ("docs/registry.md", "rapid register                                              # asks, and shows a sample"),
    ("docs/registry.md", "sudo install -D -m 644 devices.toml /etc/rapid/devices.toml"),
    ("docs/web.md", "rapid --web 0.0.0.0                         # then W in the monitor: scan the QR code"),
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The pages, by their path in the repository.
fn pages() -> Vec<String> {
    let docs = std::fs::read_dir(root().join("docs")).expect("docs/").flatten();
    let docs = docs.map(|entry| format!("docs/{}", entry.file_name().to_string_lossy()));
    let mut pages: Vec<_> = docs.filter(|name| Path::new(name).extension() == Some("md".as_ref())).collect();
    pages.extend(["README.md".to_owned(), "CONTRIBUTING.md".to_owned()]);
    pages.sort();
    pages
}

/// A fenced block.
#[derive(Debug)]
struct Block {
    page: String,
    line: usize,
    info: String,
    text: String,
}

impl Block {
    fn place(&self) -> String {
        format!("{}:{}", self.page, self.line)
    }

    fn language(&self) -> &str {
        self.info.split(' ').next().unwrap_or_default()
    }

    /// What follows `key` in the info string.
    fn option(&self, key: &str) -> Option<&str> {
        self.info.split_once(key).map(|(_, value)| value.trim())
    }
}

/// The blocks of a page, and its other lines with their numbers.
fn read(page: &str) -> (Vec<Block>, Vec<(usize, String)>) {
    let text = std::fs::read_to_string(root().join(page)).expect("a page");
    let (mut blocks, mut prose, mut open) = (Vec::new(), Vec::new(), None::<Block>);
    for (number, line) in (1..).zip(text.lines()) {
        match (&mut open, line.strip_prefix("```")) {
            (None, Some(info)) => {
                open = Some(Block { page: page.to_owned(), line: number, info: info.to_owned(), text: String::new() });
            }
            (None, None) => prose.push((number, line.to_owned())),
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (Some(block), None) => writeln!(block.text, "{line}").expect("memory"),
        }
    }
    assert!(open.is_none(), "{page}: a block is not closed");
    (blocks, prose)
}

/// Calls `check` for every block of the language and collects what it complains of.
fn check_blocks(languages: &[&str], check: impl Fn(&Block) -> Result<(), String>) {
    let blocks = pages().into_iter().flat_map(|page| read(&page).0);
    let blocks: Vec<_> = blocks.filter(|block| languages.contains(&block.language())).collect();
    assert!(!blocks.is_empty(), "no {languages:?} block at all");
    let wrong: Vec<_> = blocks
        .iter()
        .filter_map(|block| check(block).err().map(|why| format!("{}: {why}\n{}", block.place(), block.text)))
        .collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Tables of `over` replace or extend those of `under`, key by key.
fn merge(under: &mut toml::Table, over: toml::Table) {
    for (key, value) in over {
        match (under.get_mut(&key), value) {
            (Some(toml::Value::Table(under)), toml::Value::Table(over)) => merge(under, over),
            (_, value) => drop(under.insert(key, value)),
        }
    }
}

#[test]
fn every_block_is_of_a_known_kind() {
    for block in pages().into_iter().flat_map(|page| read(&page).0) {
        let known = match block.language() {
            "sh" => block.info == "sh" || block.option("not-run:").is_some_and(|reason| !reason.is_empty()),
            "toml" => ["toml registry", "toml scenario"].contains(&block.info.as_str()),
            "c" | "python" | "rust" => block.option("file=").is_some(),
            "json" | "text" | "mermaid" => block.info == block.language(),
            _ => false,
        };
        assert!(known, "{}: no test reads a block of kind {:?}", block.place(), block.info);
    }
    for page in pages() {
        for (line, text) in read(&page).1 {
            let code = text.strip_prefix("    ").is_some_and(|code| {
                ["rapid ", "make ", "cargo ", "sudo ", "["].iter().any(|start| code.starts_with(start))
            });
            assert!(!code, "{page}:{line}: write code in a fenced block, where it is tested");
        }
    }
}

#[test]
fn blocks_that_cannot_be_run_are_listed() {
    let blocks = pages().into_iter().flat_map(|page| read(&page).0);
    let found: Vec<_> = blocks.filter(|block| block.language() == "sh" && block.info != "sh").collect();
    let found: BTreeSet<_> =
        found.iter().map(|block| (block.page.as_str(), block.text.lines().next().unwrap_or_default())).collect();
    let listed: BTreeSet<_> = NOT_RUN.iter().copied().collect();
    assert_eq!(found, listed, "a block that can be run is no longer listed, a new one gets a line in NOT_RUN");
}

#[test]
fn registries_and_scenarios_are_accepted() {
    let base: toml::Table =
        std::fs::read_to_string(root().join("devices.toml")).expect("devices.toml").parse().expect("TOML");
    check_blocks(&["toml"], |block| {
        if block.info == "toml scenario" {
            let read = Scenario::parse(&block.text, None, &Registry::builtin());
            return read.map(|_| ()).map_err(|errors| errors.to_string());
        }
        let mut whole = base.clone();
        merge(&mut whole, block.text.parse().map_err(|error| format!("{error}"))?);
        // An entry has one of them.
        for device in whole["device"].as_table_mut().expect("devices").iter_mut().map(|(_, device)| device) {
            let device = device.as_table_mut().expect("an entry");
            if device["node"].as_str() != Some("serial") {
                device.remove("serial_number");
            }
        }
        let read = Registry::parse(&toml::to_string(&whole).expect("TOML"), None);
        read.map(|_| ()).map_err(|errors| errors.to_string())
    });
}

#[test]
fn json_is_json() {
    check_blocks(&["json"], |block| {
        let mut lines = block.text.lines();
        lines.try_for_each(|line| serde_json::from_str::<serde_json::Value>(line).map(drop)).map_err(|e| e.to_string())
    });
}

#[test]
fn quoted_code_is_in_its_example() {
    check_blocks(&["c", "python", "rust"], |block| {
        let path = block.option("file=").unwrap_or_default();
        let example = std::fs::read_to_string(root().join(path)).map_err(|error| format!("{path}: {error}"))?;
        if example.contains(block.text.trim()) { Ok(()) } else { Err(format!("{path} differs")) }
    });
}

#[test]
fn links_lead_to_files_and_readme_to_every_page() {
    let mut from_readme = BTreeSet::new();
    for page in pages() {
        let folder = root().join(&page).parent().expect("a folder").to_owned();
        for (line, text) in read(&page).1 {
            for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
                let path = link.split('#').next().unwrap_or_default();
                if link.starts_with("http") || path.is_empty() {
                    continue;
                }
                assert!(folder.join(path).exists(), "{page}:{line}: nothing at {path}");
                if page == "README.md" {
                    from_readme.insert(path.to_owned());
                }
            }
        }
    }
    for page in pages().into_iter().filter(|page| page.starts_with("docs/")) {
        assert!(from_readme.contains(&page), "README.md does not lead to {page}");
    }
    let readme = std::fs::read_to_string(root().join("README.md")).expect("README.md");
    assert!(readme.lines().count() <= 150, "README.md has {} lines, 150 are enough", readme.lines().count());
}

#[test]
fn files_that_the_text_names_exist() {
    const FOLDERS: [&str; 7] = ["src/", "tests/", "scripts/", "docs/", "examples/", "models/", "udev/"];
    for page in pages() {
        for (line, text) in read(&page).1 {
            for name in
                text.split('`').skip(1).step_by(2).filter(|code| FOLDERS.iter().any(|top| code.starts_with(top)))
            {
                let is_pattern = name.contains(['*', ' ', '<']) || name.chars().any(|c| c.is_ascii_uppercase());
                // What `make train` leaves is not in the repository.
                if !is_pattern && name != "models/runs/" {
                    assert!(root().join(name).exists(), "{page}:{line}: there is no {name}");
                }
            }
        }
    }
}

/// The words of a command line, as a shell would split them.
fn words(command: &str) -> Vec<String> {
    let (mut words, mut word, mut quoted, mut begun) = (Vec::new(), String::new(), false, false);
    for character in command.chars() {
        match character {
            '"' => (quoted, begun) = (!quoted, true),
            ' ' if !quoted => {
                if begun {
                    words.push(std::mem::take(&mut word));
                }
                begun = false;
            }
            '#' if !quoted && !begun => break,
            '|' | '>' | '<' | '&' | ';' if !quoted => break,
            character => {
                word.push(character);
                begun = true;
            }
        }
    }
    if begun {
        words.push(word);
    }
    words
}

/// Is the command one of ours that is understood? Others are not looked at.
fn understood(command: &str) -> Result<(), String> {
    let mut typed = words(command);
    if typed.first().is_some_and(|word| word == "sudo") {
        typed.remove(0);
        if typed.first().is_some_and(|word| word == "-u") {
            typed.drain(..2);
        }
    }
    match typed.first().map(String::as_str) {
        Some("rapid") => match Cli::read(typed.iter().map(std::ffi::OsString::from)) {
            Err(error) if error.exit_code() != 0 => Err(error.to_string()),
            _ => Ok(()),
        },
        Some("make") => {
            let makefile = std::fs::read_to_string(root().join("Makefile")).expect("Makefile");
            let targets = typed.iter().skip(1).filter(|word| !word.contains('='));
            let unknown: Vec<_> = targets
                .filter(|target| !makefile.lines().any(|line| line.starts_with(&format!("{target}:"))))
                .collect();
            if unknown.is_empty() { Ok(()) } else { Err(format!("no target {unknown:?} in the Makefile")) }
        }
        _ => Ok(()),
    }
}

#[test]
fn commands_in_the_text_are_understood() {
    let mut wrong = Vec::new();
    for page in pages() {
        let (blocks, prose) = read(&page);
        for (line, text) in prose {
            for code in text.split('`').skip(1).step_by(2) {
                // A command that is only named has no arguments.
                let named = |why: &String| {
                    why.contains("arguments were not provided") && why.contains(&format!("Usage: {code} "))
                };
                let why = understood(code).err().filter(|why| !named(why));
                wrong.extend(why.map(|why| format!("{page}:{line}: `{code}`: {why}")));
            }
        }
        for block in blocks.iter().filter(|block| block.language() == "sh") {
            let text = block.text.replace("\\\n", "");
            for command in text.lines().flat_map(|line| line.split("&& ")) {
                let why = understood(command.trim()).err();
                wrong.extend(why.map(|why| format!("{}: {command}: {why}", block.place())));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// A folder as a reader of the page has it: `rapid` and `python3` on the PATH, the registry and the examples here.
fn stage(place: &Place) -> PathBuf {
    let bin = place.path("bin");
    std::fs::create_dir(&bin).expect("a folder");
    let script = |name: &str, text: String| executable::script(&bin.join(name), &text);
    // A machine that is too busy may spoil a simulated episode: 4 reports that it is BAD, and no more. A signal is passed on.
    let text = format!(
        "#!/bin/sh\ntrap 'kill $child' TERM\n{} \"$@\" &\nchild=$!\nwait $child\ncode=$?\n\
         [ $code -lt 128 ] || {{ wait $child; code=$?; }}\n[ $code -eq 4 ] || exit $code\n",
        env!("CARGO_BIN_EXE_rapid")
    );
    script("rapid", text);
    script("python3", format!("#!/bin/sh\nexec {} -u \"$@\"\n", python().display()));
    for name in ["examples", "models", "tests"] {
        std::os::unix::fs::symlink(root().join(name), place.path(name)).expect("a link");
    }
    let programs = place.path("target/debug");
    std::fs::create_dir_all(&programs).expect("a folder");
    let built = Path::new(env!("CARGO_BIN_EXE_rapid")).with_file_name("examples");
    std::os::unix::fs::symlink(built, programs.join("examples")).expect("a link");
    bin
}

/// A run in the background of a page, whose process the page has written to `rig.pid`; ended when dropped.
struct Background(PathBuf);

impl Drop for Background {
    fn drop(&mut self) {
        let process = std::fs::read_to_string(&self.0).ok().and_then(|text| text.trim().parse().ok());
        if let Some(process) = process.and_then(rustix::process::Pid::from_raw) {
            let _ = rustix::process::kill_process(process, rustix::process::Signal::TERM);
        }
    }
}

/// Runs the blocks of a page, one after the other.
fn run_page(page: &str) {
    let place = Place::lenient();
    let _background = Background(place.path("rig.pid"));
    let bin = stage(&place);
    let path = format!("{}:{}", bin.display(), std::env::var("PATH").expect("a PATH"));
    let (blocks, _) = read(page);
    for block in blocks.iter().filter(|block| block.info == "sh") {
        let text =
            block.text.replace("rapid_hardware_mask.json", &format!("rapid_hardware_mask.{}.json", place.instance));
        let ended = Command::new("bash")
            .args(["-euo", "pipefail", "-c", &text])
            .current_dir(place.folder.path())
            .env("PATH", &path)
            .env("HOME", place.folder.path())
            .env("RAPID_INSTANCE", &place.instance)
            .env_remove("RAPID_LOG")
            .env_remove("XDG_CONFIG_HOME")
            .env_remove("XDG_STATE_HOME")
            .stdin(Stdio::null())
            .output()
            .expect("bash");
        let (output, errors) = (String::from_utf8_lossy(&ended.stdout), String::from_utf8_lossy(&ended.stderr));
        assert!(ended.status.success(), "{}: {}\n{}\n{output}\n{errors}", block.place(), ended.status, block.text);
    }
}

/// A test for each page: they run side by side.
macro_rules! pages_are_run {
    ($($test:ident: $page:literal,)*) => {
        $(#[test]
        fn $test() {
            run_page($page);
        })*

        #[test]
        fn every_page_with_commands_is_run() {
            let listed = BTreeSet::from([$($page),*]);
            for page in pages() {
                let runs = read(&page).0.iter().any(|block| block.info == "sh");
                assert_eq!(runs, listed.contains(page.as_str()), "{page}: correct the list of pages that are run");
            }
        }
    };
}

pages_are_run! {
    the_readme_runs: "README.md",
    episodes_run: "docs/episodes.md",
    export_runs: "docs/export.md",
    registry_runs: "docs/registry.md",
    policies_run: "docs/policies.md",
    interfaces_run: "docs/interfaces.md",
    scenarios_run: "docs/scenarios.md",
    nodes_run: "docs/nodes.md",
    troubleshooting_runs: "docs/troubleshooting.md",
}

/// The words and colours of a picture's fixed parts, which no busy machine changes: header, titles, headings and keys; not
/// the rows of devices and bits, and not the log.
fn looks(svg: &str) -> (BTreeSet<String>, BTreeSet<String>) {
    let mut rows: BTreeMap<u32, Vec<&str>> = BTreeMap::new();
    for text in svg.split("<text ").skip(1) {
        let row = text.split_once(" y=\"").and_then(|(_, rest)| rest.split('"').next()?.parse().ok());
        rows.entry(row.expect("its row")).or_default().push(text);
    }
    let (last, mut section, mut since) = (rows.len() - 1, "", 0);
    let mut fixed: Vec<&str> = Vec::new();
    for (number, row) in rows.values().enumerate() {
        let title = ["Mask", "Devices", "Recording", "Log"]
            .into_iter()
            .find(|title| row[1..].iter().any(|text| text.contains(&format!(">{title}<"))));
        (section, since) = title.map_or((section, since + 1), |title| (title, 0));
        let moves = match section {
            "Mask" | "Log" => since > 0,
            "Devices" => since > 1,
            _ => false,
        };
        if !moves || number == last {
            fixed.extend(row);
        }
    }
    let words = fixed
        .iter()
        .filter_map(|text| text.split_once('>')?.1.split("</text>").next())
        .flat_map(|text| text.split(|c: char| !c.is_alphabetic()))
        .filter(|word| word.len() > 2)
        .map(str::to_owned);
    let colours = fixed.iter().filter_map(|text| text.split_once("fill=\"")?.1.split('"').next()).map(str::to_owned);
    (words.collect(), colours.collect())
}

#[test]
fn the_monitor_pictures_are_current() {
    let place = Place::new();
    let ended = Command::new("python3")
        .arg(root().join("scripts/picture.py"))
        .args([Path::new(env!("CARGO_BIN_EXE_rapid")), place.folder.path()])
        .arg(&place.instance)
        .output()
        .expect("python3");
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
    let read = |path: &Path| std::fs::read_to_string(path).expect("a picture");
    let (now, committed) = (looks(&read(&place.path("monitor.svg"))), looks(&read(&root().join("docs/monitor.svg"))));
    for word in ["Mask", "streaming", "published", "Devices", "state", "Recording", "messages", "Log", "quit"] {
        assert_eq!(committed.0.contains(word), word != "streaming", "{word}: {:?}", committed.0);
    }
    assert_eq!(now, committed, "the monitor has changed: run `make picture` and look at docs/monitor.svg");
    // The titles and the names of the facts: in the colours of both, and nothing that moves.
    let names = |svg: &str| -> BTreeSet<String> {
        let texts = svg.split("<text ").filter(|text| text.contains("font-weight") || text.contains("opacity"));
        let words = texts.filter_map(|text| text.split_once('>')?.1.split("</text>").next());
        let is_name = |word: &&str| word.chars().all(|c| c.is_ascii_lowercase() || c == ' ');
        words.map(str::trim).filter(is_name).filter(|word| word.len() > 3).map(str::to_owned).collect()
    };
    let (now, committed) = (names(&read(&place.path("device.svg"))), names(&read(&root().join("docs/device.svg"))));
    for word in ["state", "rate", "identity", "topic", "space"] {
        assert!(committed.contains(word), "{word}: {committed:?}");
    }
    assert_eq!(now, committed, "the page of a device has changed: run `make picture` and look at docs/device.svg");
}
