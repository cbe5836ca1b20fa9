//! `devices.toml` entries for the bench's devices.

/// A registry of these entries.
pub fn registry(entries: &[String]) -> String {
    format!("[rig]\nname = \"vbench\"\n\n{}", entries.join("\n"))
}

/// `[verdict]` without the checks that compare with the speed of the machine: for one that is emulated and may be busy.
pub(crate) fn without_limits_of_time() -> String {
    const OFF: [&str; 10] =
        ["lost", "dropped", "repeated", "frozen", "late", "gap", "clock", "rate", "opening", "duplicate"];
    let off: String = OFF.iter().map(|check| format!("{check} = \"off\"\n")).collect();
    format!("[verdict]\n{off}[verdict.bad]\n{off}")
}

/// A 30 fps MJPG camera of the model 046d:0825, by its serial number if it has one.
pub fn camera(name: &str, topic: &str, bit: u32, serial: Option<&str>, (width, height): (u32, u32)) -> String {
    let serial = serial.map(|serial| format!("serial = \"{serial}\"\n")).unwrap_or_default();
    format!(
        "[device.{name}]\nvid = \"0x046d\"\npid = \"0x0825\"\n{serial}node = \"camera\"\n\
         topic = \"{topic}\"\nslot = \"top\"\nbit = {bit}\n\
         [device.{name}.camera]\nwidth = {width}\nheight = {height}\nfps = 30\nformat = \"MJPG\"\n"
    )
}

/// A serial line of the emulator's four numbers, of the model `vid:pid`.
pub fn scalars(name: &str, topic: &str, bit: u32, model: &str, serial: &str) -> String {
    let (vid, pid) = model.split_once(':').unwrap_or((model, ""));
    format!(
        "[device.{name}]\nvid = \"0x{vid}\"\npid = \"0x{pid}\"\nserial_number = \"{serial}\"\nnode = \"serial\"\n\
         topic = \"{topic}\"\nslot = \"tip\"\nbit = {bit}\n\
         [device.{name}.tty]\nbaud = 115200\nframing = \"line\"\nparse = \"csv\"\nchannels = 4\n"
    )
}

/// A network device behind a USB adapter of the model `vid:pid`; `lan` is the content of its table.
pub fn lan(name: &str, topic: &str, bit: u32, model: &str, serial: &str, lan: &str) -> String {
    usb(name, topic, bit, model, serial, "lan", lan)
}

/// A CAN adapter of the model `vid:pid`; `can` is the content of its table.
pub fn can(name: &str, topic: &str, bit: u32, model: &str, serial: &str, can: &str) -> String {
    usb(name, topic, bit, model, serial, "can", can)
}

fn usb(name: &str, topic: &str, bit: u32, model: &str, serial: &str, node: &str, table: &str) -> String {
    let (vid, pid) = model.split_once(':').unwrap_or((model, ""));
    format!(
        "[device.{name}]\nvid = \"0x{vid}\"\npid = \"0x{pid}\"\nserial_number = \"{serial}\"\nnode = \"{node}\"\n\
         topic = \"{topic}\"\nbit = {bit}\n[device.{name}.{node}]\n{table}\n"
    )
}
