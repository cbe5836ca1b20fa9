//! `rapid check`: the entries of the registry, or all of its mistakes.

use std::io::{self, Write};
use std::path::Path;

use rapid_core::interlock::StopKind;
use rapid_core::text;
#[cfg(feature = "motors")]
use rapid_motors::kinematics::Arm;
use rapid_registry::{
    ButtonSpec, CanProtocol, CanSpec, DeviceSpec, Diagnostic, IdentitySpec, InputSpec, InterlockSpec, Loaded,
    ModuleSpec, MotorSpec, Mount, NodeSpec, Registry, RegistryErrors, StopSpec, UsbSpec,
};
use serde::Serialize;

use super::{CommandStatus, Format, json_line};

/// Reads the registry at `path` and writes its entries, or every problem, to `out`.
///
/// # Errors
/// When `out` cannot be written to.
pub fn check(path: &Path, format: Format, out: &mut dyn Write) -> io::Result<CommandStatus> {
    let loaded = Registry::load(path).and_then(with_arms);
    let (lines, outcome) = match &loaded {
        Ok(loaded) => (lines(loaded), CommandStatus::Done),
        Err(errors) => (errors.diagnostics.iter().map(Line::Error).collect(), CommandStatus::BadConfiguration),
    };
    if format == Format::Json {
        lines.iter().try_for_each(|line| writeln!(out, "{}", json_line(line.event(), line)?))?;
        return Ok(outcome);
    }
    let summary = match &loaded {
        Ok(loaded) => {
            table(loaded, out)?;
            format!("{}, ok", text::counted(loaded.registry.devices.len() as u64, "device"))
        }
        Err(errors) => text::counted(errors.diagnostics.len() as u64, "problem"),
    };
    for line in lines {
        match line {
            // They are in the table.
            Line::Device(_) | Line::Warning(_) => {}
            Line::Module(module) => writeln!(out, "{}", module_line(module))?,
            Line::Motor(motor) => writeln!(out, "{}", text::plain(&motor.to_string()))?,
            Line::Stop(stop) => writeln!(out, "{}", stop_line(&stop))?,
            Line::Button(button) => writeln!(out, "{}", button_line(button))?,
            Line::Error(error) => writeln!(out, "{error}")?,
        }
    }
    writeln!(out, "{}: {summary}", text::plain(&path.display().to_string()))?;
    Ok(outcome)
}

/// The registry, if the description of each of its arms fits its motors.
#[cfg(feature = "motors")]
fn with_arms(loaded: Loaded) -> Result<Loaded, RegistryErrors> {
    let file = loaded.registry.path.as_ref().map(|path| path.display().to_string()).unwrap_or_default();
    let errors = loaded.registry.devices.iter().filter_map(|device| {
        let NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(motors), .. }) = &device.node else { return None };
        let error = Arm::open(motors.effector.as_deref()?, &motors.motors).err()?;
        Some(Diagnostic {
            file: file.clone(),
            line: 0,
            column: 0,
            entry: Some(format!("device.{}.effector", device.name)),
            message: text::plain(&error.to_string()).into_owned(),
            fix: Some(error.fix().to_owned()),
        })
    });
    let diagnostics: Vec<_> = errors.collect();
    if diagnostics.is_empty() { Ok(loaded) } else { Err(RegistryErrors { diagnostics }) }
}

/// Without motors there are no arms.
#[cfg(not(feature = "motors"))]
#[expect(clippy::unnecessary_wraps, reason = "the same signature as with motors")]
fn with_arms(loaded: Loaded) -> Result<Loaded, RegistryErrors> {
    Ok(loaded)
}

fn lines(loaded: &Loaded) -> Vec<Line<'_>> {
    let Loaded { registry, warnings } = loaded;
    let mut lines: Vec<_> = registry.devices.iter().map(|device| Line::Device(row(device))).collect();
    lines.extend(registry.modules.iter().map(Line::Module));
    lines.extend(motors(registry).map(Line::Motor));
    lines.extend(registry.stops.iter().map(|stop| Line::Stop(StopRow::new(stop))));
    lines.extend(registry.buttons.iter().map(Line::Button));
    lines.extend(warnings.iter().map(Line::Warning));
    lines
}

/// One line of JSON.
#[derive(Serialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
enum Line<'a> {
    Device(Row<'a>),
    Module(&'a ModuleSpec),
    Motor(MotorRow<'a>),
    Stop(StopRow<'a>),
    Button(&'a ButtonSpec),
    Warning(&'a Diagnostic),
    Error(&'a Diagnostic),
}

impl Line<'_> {
    /// Its kind among all objects that are printed: `kind` is that among those of this command.
    const fn event(&self) -> &'static str {
        match self {
            Self::Device(_) => "entry",
            Self::Module(_) => "module",
            Self::Motor(_) => "motor",
            Self::Stop(_) => "interlock",
            Self::Button(_) => "button",
            Self::Warning(_) => "warning",
            Self::Error(_) => "mistake",
        }
    }
}

/// The stop behaviour of a joint, and how its motor sits on it.
#[derive(Serialize)]
struct MotorRow<'a> {
    name: &'a str,
    device: &'a str,
    own_fault: &'static str,
    other_fault: &'static str,
    emergency: &'static str,
    /// Its line and chip.
    brake: Option<String>,
    /// What the motor reports at the zero of the joint, rad.
    zero: f64,
    /// It turns against the joint.
    reversed: bool,
}

fn motors(registry: &Registry) -> impl Iterator<Item = MotorRow<'_>> {
    let buses = registry.devices.iter().filter_map(|device| match &device.node {
        NodeSpec::Can(CanSpec { protocol: CanProtocol::Damiao(motors), .. }) => Some((device, motors)),
        _ => None,
    });
    buses.flat_map(|(device, bus)| bus.motors.iter().map(|motor| MotorRow::new(device, motor)))
}

impl<'a> MotorRow<'a> {
    fn new(device: &'a DeviceSpec, motor: &'a MotorSpec) -> Self {
        let StopSpec { own_fault, other_fault, emergency, .. } = motor.stop;
        Self {
            name: &motor.name,
            device: &device.name,
            own_fault: own_fault.word(),
            other_fault: other_fault.word(),
            emergency: emergency.word(),
            brake: motor.brake.as_ref().map(|brake| format!("line {} of {}", brake.line, brake.chip.display())),
            zero: motor.mounting.zero,
            reversed: motor.mounting.reversed,
        }
    }
}

impl std::fmt::Display for MotorRow<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, device, own_fault, other_fault, emergency, brake, zero, reversed } = self;
        write!(
            f,
            "motor {name} of {device}: {own_fault} on its own fault, {other_fault} on another's, {emergency} on an emergency \
             stop"
        )?;
        brake.iter().try_for_each(|brake| write!(f, "; brake on {brake}"))?;
        if *zero != 0.0 {
            write!(f, "; zero of the joint at {zero} rad of the motor")?;
        }
        if *reversed {
            f.write_str("; reversed")?;
        }
        Ok(())
    }
}

/// Named `stops_as` because `kind` is the type of the line.
#[derive(Serialize)]
struct StopRow<'a> {
    name: &'a str,
    stops_as: StopKind,
    actuators: &'a [String],
    input: &'a InputSpec,
}

impl<'a> StopRow<'a> {
    fn new(stop: &'a InterlockSpec) -> Self {
        Self { name: &stop.name, stops_as: stop.kind, actuators: &stop.actuators, input: &stop.input }
    }
}

#[derive(Serialize)]
struct Row<'a> {
    bit: u8,
    name: &'a str,
    node: &'static str,
    #[serde(flatten)]
    identity: &'a IdentitySpec,
    slot: Option<Mount>,
    topic: &'a str,
    format: String,
    max_bytes: usize,
    depth: usize,
}

fn row(device: &DeviceSpec) -> Row<'_> {
    Row {
        bit: device.id.bit(),
        name: &device.name,
        node: device.node.kind(),
        identity: &device.identity,
        slot: device.mount,
        topic: &device.topic,
        format: device.node.format(),
        max_bytes: device.max_bytes,
        depth: device.depth,
    }
}

fn unit(usb: &UsbSpec) -> String {
    let place = match (&usb.serial, &usb.port) {
        (Some(serial), _) => format!(" serial {}", serial.escape_debug()),
        (None, Some(port)) => format!(" port {port}"),
        (None, None) => " any unit".to_owned(),
    };
    format!("{:04x}:{:04x}{place}", usb.vid, usb.pid)
}

fn module_line(module: &ModuleSpec) -> String {
    let tags: Vec<String> = module.tags.iter().map(|(key, value)| format!("{key}={value}")).collect();
    let mut line = format!("module {} in slot {}", module.name, module.mount);
    for (what, words) in [("sensors", &module.devices), ("tags", &tags)] {
        if !words.is_empty() {
            line += &[", ", what, " ", &words.join(" ")].concat();
        }
    }
    text::plain(&line).into_owned()
}

fn stop_line(stop: &StopRow<'_>) -> String {
    let what = if stop.actuators.is_empty() { "nothing".to_owned() } else { stop.actuators.join(" ") };
    let line = format!("{} {}: {}; stops {what}", stop.stops_as.label(), stop.name, stop.input.text("runs", "stops"));
    text::plain(&line).into_owned()
}

fn button_line(button: &ButtonSpec) -> String {
    let hold = format!("held for {:?}", button.hold_after);
    let gestures = [("press", button.press), (hold.as_str(), button.hold), ("two presses", button.double)];
    let actions = gestures.into_iter().filter_map(|(gesture, action)| Some(format!("; {gesture}: {}", action?)));
    let input = button.input.text("pressed", "released");
    text::plain(&format!("button {}: {input}{}", button.name, actions.collect::<String>())).into_owned()
}

fn table(loaded: &Loaded, out: &mut dyn Write) -> io::Result<()> {
    let header = ["bit", "name", "node", "identity", "topic", "format"].map(str::to_owned);
    let mut rows = vec![header];
    for device in &loaded.registry.devices {
        let row = row(device);
        let identity = row.identity.usb().map_or_else(|| "on the network".to_owned(), unit);
        let cells = [row.bit.to_string(), row.name.into(), row.node.into(), identity, row.topic.into(), row.format];
        rows.push(cells);
    }
    let mut widths = [0; 6];
    for row in &rows {
        for (width, cell) in widths.iter_mut().zip(row) {
            *width = cell.chars().count().max(*width);
        }
    }
    for row in &rows {
        let cells: Vec<String> = row.iter().zip(widths).map(|(cell, width)| format!("{cell:<width$}")).collect();
        writeln!(out, "{}", cells.join("  ").trim_end())?;
    }
    for warning in &loaded.warnings {
        writeln!(out, "warning: {warning}")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(text: &str, format: Format) -> (CommandStatus, String) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("devices.toml");
        std::fs::write(&path, text).unwrap();
        let mut out = Vec::new();
        let outcome = check(&path, format, &mut out).unwrap();
        (outcome, String::from_utf8(out).unwrap().replace(&path.display().to_string(), "devices.toml"))
    }

    #[test]
    fn a_good_registry_is_listed() {
        let (outcome, text) = checked(rapid_registry::BUILTIN, Format::Text);
        assert_eq!(outcome, CommandStatus::Done);
        assert_eq!(
            text,
            "bit  name         node    identity                  topic                  format\n\
             0    cam_wrist    camera  046d:0825 serial CAM00A1  /rapid/camera/wrist    640x480@30 MJPG\n\
             1    tactile_tip  camera  2bc5:0501 serial TAC00B1  /rapid/camera/tactile  320x240@30 MJPG\n\
             2    motor_state  serial  2e8a:000a serial MOT00C1  /rapid/serial/motor    115200 baud line csv x3\n\
             devices.toml: 3 devices, ok\n"
        );
    }

    #[test]
    fn warnings_and_problems_are_listed_and_problems_fail_the_check() {
        let (outcome, text) = checked("[device.a]\nvid = \"1\"\npid = \"2\"\nnode = \"camera\"\n", Format::Text);
        assert_eq!(outcome, CommandStatus::Done);
        assert!(text.contains("warning: devices.toml:1:9: [device.a] no bit given, it gets bit 0"), "{text}");
        assert!(text.ends_with("devices.toml: 1 device, ok\n"), "{text}");
        let (outcome, text) = checked("[device.a]\nvid = \"1\"\npid = \"2\"\nnode = \"camrea\"\n", Format::Text);
        assert_eq!(outcome, CommandStatus::BadConfiguration);
        assert_eq!(
            text,
            "devices.toml:4:8: [device.a] node \"camrea\" is neither built in nor a program\n    fix: did you mean \"camera\"?\n\
             devices.toml: 1 problem\n"
        );
    }

    #[test]
    fn the_stop_behaviour_and_the_mounting_of_each_joint_are_listed() {
        let motors = "[device.arm]\nvid = \"2e88\"\npid = \"4603\"\nnode = \"can\"\nbit = 0\n[device.arm.can]\n\
                      adapter = \"damiao\"\nprotocol = \"damiao\"\nmotors = [\n\
                      { name = \"lift\", slave = 1, type = \"DM4310\", kp = 20, kd = 1, position = [0, 1], \
                      other_fault = \"brake\", brake = { chip = \"/dev/brakes\", line = 4, released = \"high\" } },\n\
                      { name = \"wheel\", slave = 2, type = \"DM4310\", mode = \"velocity\", position = [-9, 9] },\n\
                      { name = \"grip\", slave = 3, type = \"DM4310\", mode = \"velocity\", position = [-1, 1], \
                      zero = 0.25, reversed = true },\n]\n";
        let (outcome, text) = checked(motors, Format::Text);
        assert_eq!(outcome, CommandStatus::Done, "{text}");
        for line in [
            "motor lift of arm: limp on its own fault, brake on another's, limp on an emergency stop; brake on line 4 of \
             /dev/brakes\n",
            "motor wheel of arm: limp on its own fault, hold on another's, limp on an emergency stop\n",
            "motor grip of arm: limp on its own fault, hold on another's, limp on an emergency stop; zero of the joint at \
             0.25 rad of the motor; reversed\n",
        ] {
            assert!(text.contains(line), "{text}");
        }
        let (_, json) = checked(motors, Format::Json);
        assert!(json.contains(
            r#"{"event":"motor","kind":"motor","name":"lift","device":"arm","own_fault":"limp","other_fault":"brake""#
        ));
        assert!(json.contains(r#""brake":null,"zero":0.25,"reversed":true}"#), "{json}");
    }

    #[test]
    fn stops_are_listed() {
        let stops = "[stop.pendant]\nkind = \"emergency\"\n\
                     serial = { path = \"/dev/ttyUSB7\", run = \"RUN\" }\n[stop.pedal]\nkind = \"enabling\"\n\
                     field = { device = \"motor_state\", index = 2, runs_above = 0.5 }\n[stop.door]\n\
                     kind = \"emergency\"\ngpio = { chip = \"/dev/gpiochip0\", line = 17, runs_while = \"low\" }\n\
                     [stop.key]\nkind = \"emergency\"\nkey = { device = \"a pad\", code = \"KEY_B\" }\n";
        let text = format!("{}{stops}", rapid_registry::BUILTIN);
        let (_, text_out) = checked(&text, Format::Text);
        for line in [
            "emergency stop pendant: /dev/ttyUSB7 at 115200 baud, runs with \"RUN\", lost after 200ms without it; stops nothing",
            "enabling switch pedal: number 2 of motor_state, runs above 0.5, lost after 200ms without it; stops nothing",
            "emergency stop door: line 17 of /dev/gpiochip0, runs while low; stops nothing",
            "emergency stop key: KEY_B of a pad, runs while not pressed; stops nothing",
        ] {
            assert!(text_out.lines().any(|is| is == line), "{line} not in {text_out}");
        }
        let (_, json) = checked(&text, Format::Json);
        let rows: Vec<serde_json::Value> = json.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        let pedal = rows.iter().find(|row| row["name"] == "pedal").unwrap();
        assert_eq!((&pedal["kind"], &pedal["stops_as"]), (&"stop".into(), &"enabling".into()));
        assert_eq!(pedal["input"]["field"]["on"]["above"], 0.5);
    }

    #[test]
    fn buttons_are_listed() {
        let buttons = "[button.pedal]\nkey = { device = \"a pad\", code = \"KEY_B\", grab = true }\n\
                       press = \"toggle\"\nhold = \"discard\"\ndouble = \"redo\"\n[button.go]\n\
                       serial = { path = \"/dev/ttyUSB7\", line = \"go\" }\npress = \"start\"\n[button.lever]\n\
                       serial = { path = \"/dev/ttyUSB7\", pressed = \"down\", released = \"up\" }\n\
                       press = \"stop\"\n[button.panel]\n\
                       gpio = { chip = \"/dev/gpiochip0\", line = 17, pressed_while = \"low\" }\n\
                       press = \"disarm\"\n[button.grip]\nfield = { device = \"motor_state\", index = 2, \
                       pressed_above = 0.5, released_below = 0.25 }\npress = \"mark\"\n";
        let text = format!("{}{buttons}", rapid_registry::BUILTIN);
        let (_, text_out) = checked(&text, Format::Text);
        for line in [
            "button pedal: KEY_B of a pad, which no other program gets; press: toggle; held for 1s: discard; two presses: redo",
            "button go: /dev/ttyUSB7 at 115200 baud, pressed with \"go\"; press: start",
            "button lever: /dev/ttyUSB7 at 115200 baud, pressed with \"down\", released with \"up\"; press: stop",
            "button panel: line 17 of /dev/gpiochip0, pressed while low; press: disarm",
            "button grip: number 2 of motor_state, pressed above 0.5, released below 0.25, lost after 500ms without it; press: mark",
        ] {
            assert!(text_out.lines().any(|is| is == line), "{line} not in {text_out}");
        }
        let (_, json) = checked(&text, Format::Json);
        let rows: Vec<serde_json::Value> = json.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        let pedal = rows.iter().find(|row| row["name"] == "pedal").unwrap();
        assert_eq!((&pedal["kind"], &pedal["hold"]), (&"button".into(), &"discard".into()));
        assert_eq!(pedal["input"]["key"]["grab"], true);
    }

    #[test]
    fn json_is_one_object_per_line() {
        let (_, text) = checked(rapid_registry::BUILTIN, Format::Json);
        let rows: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(rows.len(), 3);
        assert_eq!((&rows[0]["event"], &rows[0]["kind"]), (&"entry".into(), &"device".into()));
        assert_eq!(rows[0]["serial"], "CAM00A1");
        assert_eq!(rows[2]["format"], "115200 baud line csv x3");
        let (outcome, text) = checked("[device.a]\n", Format::Json);
        assert_eq!(outcome, CommandStatus::BadConfiguration);
        let first: serde_json::Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
        assert_eq!((&first["kind"], &first["line"]), (&"error".into(), &1.into()));
    }
}
