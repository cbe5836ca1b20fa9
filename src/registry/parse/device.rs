//! One `[device.NAME]` table.

use std::path::Path;
use std::time::Duration;

use toml::de::DeValue;

use super::name::name_problem;
use super::program::{For, Programs};
use super::verdict::{VerdictTable, Whose};
use super::{action, can, hooks, identity, lan, motors, node, process, verdict};
use crate::modality::{ModalityId, ModalityKind};
use crate::registry::diagnostic::did_you_mean;
use crate::registry::limits::VerdictSpec;
use crate::registry::section::{At, Problems, Section};
use crate::registry::spec::{
    ActionSpec, CanProtocol, CanSpec, DeviceSpec, Hook, Hooks, IdentitySpec, LanProtocol, LanSpec, Mount, NodeSpec,
    Opens, WhenStale,
};

/// Kinds of node this version has a driver for.
pub(super) const BUILT_IN: [(&str, Kind); 4] =
    [("camera", Kind::Camera), ("serial", Kind::Serial), ("can", Kind::Can), ("lan", Kind::Lan)];
/// Says that `on_attach` is the program that reads the device.
const PROCESS: &str = "process";
const KEYS: [&str; 24] = [
    "vid",
    "pid",
    "serial",
    "serial_number",
    "port",
    "node",
    "topic",
    "bit",
    "slot",
    "stall_after",
    "max_bytes",
    "depth",
    "when_stale",
    "latency",
    "camera",
    "can",
    "lan",
    "process",
    "verdict",
    "action",
    "on_attach",
    "on_detach",
    "on_record_start",
    "on_record_stop",
];

/// The mask is 64 bits wide.
const HIGHEST_BIT: i64 = 63;

/// More than any sensor takes; every frame of an episode waits for the longest latency of the rig.
const LONGEST_LATENCY: Duration = Duration::from_secs(1);

/// How a device is read, without the settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Camera,
    Serial,
    Can,
    Lan,
    Process,
}

/// An entry as far as it could be read.
#[derive(Debug)]
pub(super) struct Draft<'a> {
    pub(super) name: String,
    pub(super) section: Section<'a>,
    pub(super) identity: Option<IdentitySpec>,
    pub(super) kind: Option<Kind>,
    node: Option<NodeSpec>,
    pub(super) topic: String,
    pub(super) bit: Option<At<u8>>,
    pub(super) id: Option<ModalityId>,
    pub(super) mount: Option<Mount>,
    stall_after: Duration,
    pub(super) max_bytes: u64,
    pub(super) depth: u64,
    /// The depth was written in the file and is not ours to lower.
    pub(super) depth_written: bool,
    when_stale: WhenStale,
    latency: Duration,
    verdict: VerdictTable,
    pub(super) action: Option<ActionSpec>,
    hooks: Hooks,
}

impl Draft<'_> {
    /// The entry, with what `[verdict]` says for all; `None` only if a problem with it was reported.
    pub(super) fn finish(self, rig: &VerdictTable) -> Option<DeviceSpec> {
        let node = self.node?;
        let fps = match &node {
            NodeSpec::Camera(camera) => Some(f64::from(camera.fps)),
            NodeSpec::Lan(lan) => lan.rate(),
            _ => None,
        };
        let mut usual = VerdictSpec::of(node.modality_kind(), self.stall_after, fps);
        if matches!(&node, NodeSpec::Lan(lan) if matches!(lan.protocol, LanProtocol::Gopro { .. })) {
            // Its samples are looks at its state, once a second, and no observation: its pictures are in the clip.
            (usual.suspect.valid, usual.bad.valid) = (None, None);
        }
        Some(DeviceSpec {
            verdict: verdict::changed(usual, rig, &self.verdict),
            name: self.name,
            id: self.id?,
            identity: self.identity?,
            node,
            topic: self.topic,
            mount: self.mount,
            stall_after: self.stall_after,
            max_bytes: usize::try_from(self.max_bytes).ok()?,
            depth: usize::try_from(self.depth).ok()?,
            when_stale: self.when_stale,
            latency: self.latency,
            action: self.action,
            hooks: self.hooks,
        })
    }

    /// How many numbers a sample holds, 0 if it holds none; `None` if a problem with the node was reported.
    pub(super) fn numbers(&self) -> Option<usize> {
        let node = self.node.as_ref()?;
        let count = match node.modality_kind() {
            ModalityKind::Scalars => node.shape().first().copied().unwrap_or(0),
            ModalityKind::Image | ModalityKind::Bytes => 0,
        };
        usize::try_from(count).ok()
    }

    /// It is moved by a program that reads it as well.
    pub(super) fn is_moved_by_a_program(&self) -> bool {
        self.action.is_some() && self.kind == Some(Kind::Process)
    }

    pub(super) fn default_topic(&self) -> String {
        default_topic(self.kind, &self.name)
    }

    /// The key the serial number is written under.
    pub(super) fn serial_key(&self) -> &'static str {
        if self.section.has("serial_number") { "serial_number" } else { "serial" }
    }

    /// Which node of the unit the entry takes.
    pub(super) fn opens(&self) -> Option<Opens> {
        Some(self.node.as_ref()?.opens())
    }

    /// The programs that are run for it, each with the key that names it.
    pub(super) fn programs(&self) -> impl Iterator<Item = (&'static str, &Path)> {
        let key = if attach_is_node(&self.section) { "on_attach" } else { "node" };
        let node = self.node.as_ref().and_then(|node| match node {
            NodeSpec::Process(process) => Some((key, process.program.as_path())),
            NodeSpec::Camera(_) | NodeSpec::Serial(_) | NodeSpec::Can(_) | NodeSpec::Lan(_) => None,
        });
        node.into_iter().chain(self.hooks.all().map(|(key, hook)| (key, hook.program.as_path())))
    }

    /// Its settings, if it is on the network.
    pub(super) fn lan(&self) -> Option<&LanSpec> {
        match self.node.as_ref()? {
            NodeSpec::Lan(lan) => Some(lan),
            _ => None,
        }
    }

    pub(super) fn is_camera(&self) -> bool {
        self.kind == Some(Kind::Camera)
    }
}

/// Reads one entry.
pub(super) fn read<'a>(
    name: &str,
    section: Section<'a>,
    programs: Programs<'_>,
    problems: &mut Problems<'_>,
) -> Draft<'a> {
    check_name(name, &section, problems);
    check_keys(&section, problems);
    let kind = kind(&section, problems);
    let identity = identity::identity(kind, &section, problems);
    let mut heartbeat = None;
    let settings = match kind {
        Some(Kind::Camera) => Some(NodeSpec::Camera(node::camera(&section, problems))),
        Some(Kind::Serial) => node::serial(&section, problems).map(NodeSpec::Serial),
        Some(Kind::Can) => can::can(&section, problems).map(NodeSpec::Can),
        Some(Kind::Lan) => lan::lan(&section, problems).map(NodeSpec::Lan),
        Some(Kind::Process) => {
            process::process(&section, program(&section, programs, problems), problems).map(|(process, silent)| {
                heartbeat = Some(silent);
                NodeSpec::Process(process)
            })
        }
        None => None,
    };
    if kind.is_some_and(|kind| kind != Kind::Process) && section.has("process") {
        let message = format!("a built-in node has no table [{}]", section.child("process"));
        section.report(problems, "process", message, "remove the table, or write node = the name of a program");
    }
    if kind.is_some_and(|kind| kind != Kind::Can) && section.has("can") {
        let message = format!("only a CAN adapter has a table [{}]", section.child("can"));
        section.report(problems, "can", message, "remove the table, or write node = \"can\"");
    }
    let topic = topic(&section, problems).unwrap_or_else(|| default_topic(kind, name));
    let bit = section
        .integer(problems, "bit", 0..=HIGHEST_BIT)
        .and_then(|bit| Some(At { at: bit.at, value: u8::try_from(bit.value).ok()? }));
    let mount = section.choice(problems, "slot", &Mount::WORDS);
    let when_stale = section.choice(problems, "when_stale", &WhenStale::WORDS).unwrap_or_default();
    let stall = Duration::from_millis(10)..=Duration::from_hours(1);
    let stall_after = heartbeat
        .or_else(|| section.duration(problems, "stall_after", stall))
        .unwrap_or_else(|| node::default_stall(settings.as_ref()));
    let latency = section.duration(problems, "latency", Duration::ZERO..=LONGEST_LATENCY).unwrap_or_default();
    let max_bytes = node::max_bytes(&section, settings.as_ref(), problems);
    let action = match &settings {
        Some(NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(damiao), .. })) => {
            Some(motors::axes(damiao, &section, problems))
        }
        settings => {
            let moves = settings.as_ref().is_none_or(|node| matches!(node, NodeSpec::Process(_)));
            action::action(&section, moves || programs.are_nowhere(), problems)
        }
    };
    let written = section.integer(problems, "depth", 2..=4096).and_then(|depth| u64::try_from(depth.value).ok());
    Draft {
        name: name.to_owned(),
        identity,
        kind,
        topic,
        bit,
        id: None,
        mount,
        stall_after,
        max_bytes,
        depth: written.unwrap_or_else(|| node::default_depth(settings.as_ref())),
        depth_written: written.is_some(),
        when_stale,
        latency,
        verdict: verdict::read(&section, Whose::Device, problems),
        action,
        hooks: hooks::hooks(&section, attach_is_node(&section), programs, problems),
        node: settings,
        section,
    }
}

fn check_name(name: &str, section: &Section<'_>, problems: &mut Problems<'_>) {
    if let Some((message, fix)) = name_problem(name) {
        problems.report(section.at, &section.entry, message, fix);
    }
}

fn check_keys(section: &Section<'_>, problems: &mut Problems<'_>) {
    for (at, key, _) in section.fields() {
        if KEYS.contains(&key) {
            continue;
        }
        let fix = did_you_mean(key, &KEYS, "known keys here");
        problems.report(at, &section.entry, format!("unknown key {key:?}"), fix);
    }
}

fn kind(section: &Section<'_>, problems: &mut Problems<'_>) -> Option<Kind> {
    if !section.has("node") {
        section.missing(
            problems,
            "node",
            "write node = \"camera\", \"serial\", \"can\", \"lan\" or the name of a program",
        );
        return None;
    }
    let text = section.text(problems, "node")?.value;
    if text == PROCESS && !section.has("on_attach") {
        let fix = "write node = the name of the program, for example node = \"tactile_publisher\", or add on_attach = \
                   [\"tactile_publisher\", \"argument\"]";
        section.report(problems, "node", "node \"process\" does not say which program".to_owned(), fix);
        return None;
    }
    Some(BUILT_IN.iter().find(|(name, _)| *name == text).map_or(Kind::Process, |(_, kind)| *kind))
}

/// Is `on_attach` the program that reads the device?
fn attach_is_node(section: &Section<'_>) -> bool {
    let is_process = |key: &str, value: &DeValue<'_>| key == "node" && value.as_str() == Some(PROCESS);
    section.has("on_attach") && section.fields().iter().any(|(_, key, value)| is_process(key, value.get_ref()))
}

/// The program that reads the device: what `node` names, or with `node = "process"` what `on_attach` does.
fn program(section: &Section<'_>, programs: Programs<'_>, problems: &mut Problems<'_>) -> Option<Hook> {
    if attach_is_node(section) {
        return hooks::hook(section, "on_attach", programs, problems);
    }
    let name = section.text(problems, "node")?;
    let found = programs.find(For::Node, name.value);
    let program = found.map_err(|(message, fix)| section.report(problems, "node", message, fix)).ok()?;
    Some(Hook { program, args: Vec::new() })
}

fn default_topic(kind: Option<Kind>, name: &str) -> String {
    let word = BUILT_IN.iter().find(|(_, built_in)| Some(*built_in) == kind).map(|(word, _)| *word);
    let kind = word.unwrap_or(if kind == Some(Kind::Process) { "process" } else { "device" });
    format!("/rapid/{kind}/{name}")
}

fn topic(section: &Section<'_>, problems: &mut Problems<'_>) -> Option<String> {
    /// Longest name of an iceoryx2 service is 255 bytes.
    const LONGEST: usize = 200;
    let topic = section.text(problems, "topic")?.value;
    let legal = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '/');
    let (message, fix) = if !topic.starts_with('/') {
        (format!("topic {topic:?} does not begin with `/`"), format!("write {:?}", format!("/{topic}")))
    } else if let Some(odd) = topic.chars().find(|c| !legal(*c)) {
        (format!("topic {topic:?} contains {odd:?}"), "use letters, digits, `_`, `-` and `/`".to_owned())
    } else if topic.ends_with('/') || topic.contains("//") {
        (format!("topic {topic:?} has an empty part"), "write one `/` between names and none at the end".to_owned())
    } else if topic.len() > LONGEST {
        ("the topic is too long".to_owned(), format!("use at most {LONGEST} characters"))
    } else {
        return Some(topic.to_owned());
    };
    section.report(problems, "topic", message, fix);
    None
}
