//! One `[device.NAME]` table.
//!
//! Of the devices that `rapid` reads itself, only motors behind a CAN adapter move, without a table `[device.NAME.action]`:
//! each of them is an axis, or the tip of their arm has the axes. A program may move anything.

use std::path::Path;
use std::time::Duration;

use rapid_core::action::MAX_ACTION;
use rapid_core::modality::{ModalityId, ModalityKind};
use rapid_core::sync::WhenStale;

use super::identity::name_problem;
use super::program::{self, Programs};
use super::verdict::{VerdictTable, Whose};
use super::{form, identity, verdict};
use crate::columns::Vector;
use crate::keys::{About, Keys, NUMBERS, Own, Size, TEXT, TEXTS, Time, Words, keys, own, text, whole};
use crate::kinds::process::{PROCESS, attach_is_node};
use crate::kinds::{self, Kind, STALL_AFTER, Word, can};
use crate::section::Section;
use crate::spec::VerdictSpec;
use crate::spec::{
    ActionSpec, CameraSpec, CanProtocol, CanSpec, DeviceSpec, Form, Hooks, IdentitySpec, LanSpec, Mount, NodeSpec,
    Opens, PixelFormat, RigSpec,
};

/// Keys that state which device an entry identifies.
pub(crate) const IDENTITY_KEYS: [&str; 5] = ["vid", "pid", "serial", "serial_number", "port"];
/// The further streams of a camera.
const STREAM: &str = "stream";

keys! {
    /// Which device the entry identifies, and how it is read.
    pub(crate) const OF_THE_DEVICE {
        /// USB vendor id, as `lsusb` shows it.
        vid = USB_ID, usually "a device on the network has none";
        /// USB product id.
        pid = USB_ID, usually "likewise";
        /// Serial number. In files of the last release, the table of a serial line.
        serial = SERIAL, usually "any unit of the model";
        /// Serial number, in an entry whose table of a serial line is still called `serial`.
        serial_number = TEXT;
        /// USB port, instead of the serial number: `"1-2.3"`.
        port = TEXT;
        /// How it is read: `"camera"`, `"serial"`, `"can"`, `"lan"`, `"process"`, or the name of a program.
        node = TEXT, need "";
    }
}

keys! {
    /// The keys that a stream of a device has too.
    #[derive(Debug)]
    pub(crate) struct StreamKeys(least_bytes: u64) {
        /// Topic on the bus and in the recording.
        topic: Option<String> = TOPIC, usually "`/rapid/` with the node and the name";
        /// Bit in the physical mask.
        bit: Option<u8> = whole::<u8>(0, HIGHEST_BIT), usually "the lowest free one";
        /// Where the module is mounted.
        slot: Option<Mount> = Words(&Mount::WORDS), usually "none";
        /// Attached, but silent for this long: shown as stalled.
        stall_after: Option<Duration> = Time(Duration::from_millis(10), Duration::from_hours(1)), usually "`\"500ms\"`, or ten pictures";
        /// Largest sample: shared memory is reserved for it.
        max_bytes: Option<u64> = Size(1, 256 << 20), within Size(least_bytes, 256 << 20), usually "by kind";
        /// Samples that a reader may fall behind before the oldest is lost.
        depth: Option<u64> = whole::<u64>(2, 4096), usually "by kind";
        /// At a tick without a sample in the window: the newest with its age, or zeros.
        when_stale: WhenStale = Words(&WhenStale::WORDS), or WhenStale::default();
        /// From an event to the capture time of the sample that shows it.
        latency: Duration = Time(Duration::ZERO, LONGEST_LATENCY), or Duration::ZERO;
    }
}

keys! {
    /// Tables of a stream.
    const TABLES_OF_A_STREAM {} => {
        /// A camera.
        camera = About::Table(&[CameraSpec::KEYS]);
        /// Limits of the verdict for this device.
        verdict = About::Table(verdict::OF_A_DEVICE);
        /// Intrinsics of its images.
        calibration = About::Table(&[form::CalibrationKeys::KEYS]);
    }
}

keys! {
    /// Tables of a device.
    pub(crate) const TABLES {} => {
        /// Limits of the verdict for this device.
        verdict = About::Table(verdict::OF_A_DEVICE);
        /// The actions of a program's actuator.
        action = About::Table(&[ActionKeys::KEYS]);
        /// Its values are a pose.
        pose = About::Table(&form::POSE_KEYS);
        /// Its values are the states of joints.
        joints = About::Table(&[form::JointsKeys::KEYS]);
        /// Intrinsics of its images.
        calibration = About::Table(&[form::CalibrationKeys::KEYS]);
        /// Its packets are those of a LiDAR.
        points = About::Table(&[form::PointsKeys::KEYS]);
        /// The tip of an arm, whose pose is commanded.
        effector = About::Table(&[can::EffectorKeys::KEYS]);
        /// Further streams of a camera.
        stream = About::Named(OF_A_STREAM);
    }
}

keys! {
    /// Programs that are run at events of the device.
    pub(crate) const HOOKS {
        /// A program that is run when the device was attached, and its arguments.
        on_attach = TEXTS;
        /// Likewise, when it was removed.
        on_detach = TEXTS;
        /// Likewise, when an episode begins.
        on_record_start = TEXTS;
        /// Likewise, when it is over.
        on_record_stop = TEXTS;
    }
}

/// The keys of `[device.NAME.stream.NAME]`.
const OF_A_STREAM: Keys = &[StreamKeys::KEYS, TABLES_OF_A_STREAM];

const TOPIC: Own<String> = text(topic, "text that begins with `/`");
const USB_ID: Own<u16> = own(
    usb_id,
    "four hexadecimal digits",
    r#"{"anyOf": [{"type": "string", "pattern": "^(0[xX])?[0-9a-fA-F]{1,4}$"}, {"type": "integer"}]}"#,
);
const SERIAL: Own<()> = own(|_, _| None, "text", r#"{"type": ["string", "object"]}"#);

fn usb_id(table: &Section<'_>, key: &str) -> Option<u16> {
    table.usb_id(key)
}

/// The mask is 64 bits wide.
const HIGHEST_BIT: i64 = 63;

/// More than any sensor needs; every frame of an episode waits for the longest latency of the rig.
const LONGEST_LATENCY: Duration = Duration::from_secs(1);

/// An entry as far as it could be read.
#[derive(Debug)]
pub(crate) struct Draft<'a> {
    pub(crate) name: String,
    pub(crate) section: Section<'a>,
    pub(crate) identity: Option<IdentitySpec>,
    /// The entry of whose unit it is a further stream.
    pub(crate) stream_of: Option<String>,
    pub(crate) kind: Option<Word>,
    node: Option<NodeSpec>,
    pub(crate) topic: String,
    pub(crate) bit: Option<u8>,
    pub(crate) id: Option<ModalityId>,
    pub(crate) mount: Option<Mount>,
    stall_after: Duration,
    pub(crate) max_bytes: u64,
    pub(crate) depth: u64,
    /// The depth was written in the file and must not be lowered.
    pub(crate) depth_written: bool,
    when_stale: WhenStale,
    latency: Duration,
    verdict: VerdictTable,
    pub(crate) form: Option<Form>,
    pub(crate) action: Option<ActionSpec>,
    hooks: Hooks,
}

impl<'d> Draft<'d> {
    /// Its numbers, if it sends any; of an entry with a problem, which is reported, without a length.
    pub(crate) fn vector(&self) -> Option<Vector> {
        let shape = match &self.node {
            Some(node) if node.modality_kind() != ModalityKind::Scalars => return None,
            Some(node) => node.shape(),
            None => Vec::new(),
        };
        let length = shape.first().and_then(|length| usize::try_from(*length).ok()).filter(|length| *length > 0);
        let names = self.form.as_ref().map(Form::names).unwrap_or_default();
        Some(Vector { name: self.name.clone(), length, names })
    }

    /// The entry, with the settings of `[verdict]` and `[rig]`; `None` only if a problem with it was reported.
    pub(super) fn finish(self, limits: &VerdictTable, rig: &RigSpec) -> Option<(Section<'d>, DeviceSpec)> {
        let node = self.node?;
        let fps = node.picture().map(|picture| f64::from(picture.fps));
        let mut usual = VerdictSpec::defaults(node.modality_kind(), self.stall_after, fps);
        node.of_kind().judge(&mut usual, rig.sync_window);
        if rig.expect.contains(&self.name) {
            usual = usual.of_an_expected_sensor();
        }
        let spec = DeviceSpec {
            verdict: verdict::changed(usual, limits, &self.verdict),
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
            form: self.form,
            action: self.action,
            hooks: self.hooks,
        };
        Some((self.section, spec))
    }

    /// How many numbers a sample holds, 0 if it holds none; `None` if a problem with the node was reported.
    pub(crate) fn numbers(&self) -> Option<usize> {
        numbers_of(self.node.as_ref()?)
    }

    /// Which node of the unit the entry opens.
    pub(crate) fn opens(&self) -> Option<Opens> {
        Some(self.node.as_ref()?.opens())
    }

    /// The programs that are run for it, each with the key that names it.
    pub(crate) fn programs(&self) -> impl Iterator<Item = (&'static str, &Path)> {
        let key = if attach_is_node(&self.section) { "on_attach" } else { "node" };
        let node = self.node.as_ref().and_then(|node| match node {
            NodeSpec::Process(process) => Some((key, process.program.as_path())),
            NodeSpec::Camera(_) | NodeSpec::Serial(_) | NodeSpec::Can(_) | NodeSpec::Lan(_) => None,
        });
        node.into_iter().chain(self.hooks.all().map(|(key, hook)| (key, hook.program.as_path())))
    }

    /// The pixel format of a camera.
    pub(crate) const fn format(&self) -> Option<PixelFormat> {
        match &self.node {
            Some(NodeSpec::Camera(camera)) => Some(camera.format),
            _ => None,
        }
    }

    /// Its settings, if it is on the network.
    pub(crate) fn lan(&self) -> Option<&LanSpec> {
        match self.node.as_ref()? {
            NodeSpec::Lan(lan) => Some(lan),
            _ => None,
        }
    }
}

/// How many numbers a sample holds, 0 if it holds none.
fn numbers_of(node: &NodeSpec) -> Option<usize> {
    let count = match node.modality_kind() {
        ModalityKind::Scalars => node.shape().first().copied().unwrap_or(0),
        ModalityKind::Image | ModalityKind::Depth | ModalityKind::Bytes => 0,
    };
    usize::try_from(count).ok()
}

pub(crate) fn read<'a>(name: &str, section: Section<'a>, programs: Programs<'_>) -> Draft<'a> {
    if let Some((message, fix)) = name_problem(name) {
        section.report_at(section.at, message, fix);
    }
    section.known(kinds::KEYS);
    let kind = kind(&section);
    let identity = identity::identity(kind, &section);
    if kind != Some(Word::Camera) && section.has(STREAM) {
        section.report(STREAM, "only a camera has several streams", "remove the table, or write node = \"camera\"");
    }
    draft(name, section, (kind, identity), programs)
}

/// Reads the further streams of an entry, each an entry of its own with the same identity: `NAME_STREAM`.
pub(crate) fn streams<'a>(owner: &Draft<'a>, programs: Programs<'_>) -> Vec<Draft<'a>> {
    let Some(streams) = owner.section.table(STREAM).filter(|_| owner.kind == Some(Word::Camera)) else {
        return Vec::new();
    };
    let usb = owner.identity.as_ref().and_then(IdentitySpec::usb);
    if usb.is_some_and(|usb| usb.serial.is_none() && usb.port.is_none()) {
        let fix = "write its serial = \"...\" or its port = \"...\"";
        owner.section.report(
            STREAM,
            "any unit of the model fits: it is not known which one the stream belongs to",
            fix,
        );
    }
    let mut drafts = Vec::new();
    for (at, stream, value) in streams.fields() {
        let Some(table) = value.get_ref().as_table() else {
            let fix = "write it as a table, [device.NAME.stream.depth]";
            streams.report_child(at, stream, format!("{stream:?} is not a table"), fix);
            continue;
        };
        let (name, section) = (format!("{}_{stream}", owner.name), streams.part(table, at, streams.child(stream)));
        if let Some((message, fix)) = name_problem(&name) {
            section.report_at(section.at, message, fix);
        }
        section.known(OF_A_STREAM);
        let mut draft = draft(&name, section, (owner.kind, owner.identity.clone()), programs);
        if !draft.section.has("topic") {
            draft.topic = format!("{}/{stream}", owner.topic);
        }
        draft.stream_of = Some(owner.name.clone());
        drafts.push(draft);
    }
    drafts
}

/// Reads the rest of one entry.
fn draft<'a>(
    name: &str,
    section: Section<'a>,
    (kind, identity): (Option<Word>, Option<IdentitySpec>),
    programs: Programs<'_>,
) -> Draft<'a> {
    let (settings, silent) = kind.and_then(|kind| kind.read(&section, programs)).unzip();
    if kind.is_some_and(|kind| kind != Word::Process) && section.has("process") {
        let message = format!("a built-in node has no table [{}]", section.child("process"));
        section.report("process", message, "remove the table, or write node = the name of a program");
    }
    if kind.is_some_and(|kind| kind != Word::Can) && section.has("can") {
        let message = format!("only a CAN adapter has a table [{}]", section.child("can"));
        section.report("can", message, "remove the table, or write node = \"can\"");
    }
    if settings.is_some() && kind != Some(Word::Can) {
        can::refuse_effector(&section);
    }
    let of_kind = settings.as_ref().map(NodeSpec::of_kind);
    let (bytes, least_bytes) = of_kind.map_or((1, 1), Kind::sizes);
    let keys = StreamKeys::values(&section, least_bytes);
    let stall_after = silent.flatten().or(keys.stall_after);
    let stall_after = stall_after.unwrap_or_else(|| of_kind.map_or(STALL_AFTER, Kind::stall_after));
    let action = match &settings {
        Some(NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(damiao), .. })) => Some(can::axes(damiao, &section)),
        settings => {
            let moves = settings.as_ref().is_none_or(|node| matches!(node, NodeSpec::Process(_)));
            action(&section, moves || programs.are_nowhere())
        }
    };
    Draft {
        name: name.to_owned(),
        identity,
        stream_of: None,
        kind,
        topic: keys.topic.unwrap_or_else(|| default_topic(kind, name)),
        bit: keys.bit,
        id: None,
        mount: keys.slot,
        stall_after,
        max_bytes: keys.max_bytes.unwrap_or(bytes),
        depth: keys.depth.unwrap_or_else(|| of_kind.map_or(2048, Kind::depth)),
        depth_written: keys.depth.is_some(),
        when_stale: keys.when_stale,
        latency: keys.latency,
        verdict: verdict::read(&section, Whose::Device),
        form: form::form(name, &section, settings.as_ref(), settings.as_ref().and_then(numbers_of)),
        action,
        hooks: program::hooks(&section, attach_is_node(&section), programs),
        node: settings,
        section,
    }
}

fn kind(section: &Section<'_>) -> Option<Word> {
    if !section.has("node") {
        section.missing("node", "write node = \"camera\", \"serial\", \"can\", \"lan\" or the name of a program");
        return None;
    }
    let text = section.text("node")?;
    if text == PROCESS && !section.has("on_attach") {
        let fix = "write node = the name of the program, for example node = \"tactile_publisher\", or add on_attach = \
                   [\"tactile_publisher\", \"argument\"]";
        return section.refuse("node", "node \"process\" does not name the program".to_owned(), fix);
    }
    Some(Word::ALL.iter().find(|(name, _)| *name == text).map_or(Word::Process, |(_, kind)| *kind))
}

pub(crate) fn default_topic(kind: Option<Word>, name: &str) -> String {
    let kind = kind.map_or("device", Word::word);
    format!("/rapid/{kind}/{name}")
}

fn topic(section: &Section<'_>, key: &str) -> Option<String> {
    /// The longest name of an iceoryx2 service is 255 bytes.
    const LONGEST: usize = 200;
    let topic = section.text(key)?;
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
    section.refuse(key, message, fix)
}

keys! {
    /// `[device.NAME.action]`: each list has one entry per axis.
    struct ActionKeys {
        /// Names of the axes.
        names: Option<Vec<String>> = TEXTS, need "write names = a list with one entry per axis";
        /// Their units.
        units: Option<Vec<String>> = TEXTS, need "write units = a list with one entry per axis";
        /// Their lowest targets.
        min: Option<Vec<f64>> = NUMBERS, need "write min = a list with one entry per axis";
        /// Their highest targets.
        max: Option<Vec<f64>> = NUMBERS, need "write max = a list with one entry per axis";
    }
}

/// Reads the table; `None` without one, or if a problem with it was reported. A table for a device that does not `move`
/// is such a problem.
pub(crate) fn action(section: &Section<'_>, moves: bool) -> Option<ActionSpec> {
    let table = section.table("action")?;
    if !moves {
        let node = section.text("node").unwrap_or_default();
        let message = format!("node {node:?} takes no actions: nothing would move");
        let fix = "remove the table; motors behind a CAN adapter are axes without one (protocol = \"damiao\"), and any \
                   other device is moved by a program (node = its name)";
        return section.refuse("action", message, fix);
    }
    let ActionKeys { names, units, min, max } = ActionKeys::read(&table);
    let (names, units, min, max) = (names?, units?, min?, max?);
    if names.is_empty() || names.len() > MAX_ACTION {
        let fix = format!("name 1 to {MAX_ACTION} axes");
        return table.refuse("names", format!("{} axes", names.len()), fix);
    }
    for (key, length) in [("units", units.len()), ("min", min.len()), ("max", max.len())] {
        if length != names.len() {
            let message = format!("{length} entries for {} axes", names.len());
            return table.refuse(key, message, "give each axis one entry");
        }
    }
    for (name, (low, high)) in names.iter().zip(min.iter().zip(&max)) {
        if !(low.is_finite() && high.is_finite() && low < high) {
            let message = format!("{name} from {low} to {high} is not a range");
            return table.refuse("max", message, "write finite numbers, max above min");
        }
    }
    Some(ActionSpec { names, units, min, max })
}
