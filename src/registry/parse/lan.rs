//! `[device.NAME.lan]`.

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use rapid_core::modality::ModalityKind;
use rapid_core::remote;

use super::device::{Draft, IDENTITY_KEYS};
use crate::section::Section;
use crate::spec::{KINDS, LanFind, LanPicture, LanProtocol, LanSpec, PhoneStream, PixelFormat, Probe, RemoteSamples};

const KEYS: [&str; 8] = ["protocol", "mdns", "instance", "host", "port", "probe", "probe_port", "lease"];
/// Keys of the table that only some protocols have.
const OWN: [(Word, &[&str]); 5] = [
    (Word::Mjpeg, &["path", "width", "height", "fps"]),
    (Word::Udp, &[]),
    (Word::Gopro, &["download", "stream", "width", "height", "fps"]),
    (Word::Iphone, &["stream", "width", "height", "fps"]),
    (Word::Remote, &["device", "kind", "width", "height", "fps", "format", "channels"]),
];
const OPTIONAL: [&str; 10] =
    ["path", "width", "height", "fps", "download", "stream", "device", "kind", "format", "channels"];
/// Keys for pictures of another computer, for pictures of distances, and for its numbers.
const OF_PICTURES: [&str; 4] = ["width", "height", "fps", "format"];
const OF_DEPTH: [&str; 3] = ["width", "height", "fps"];
const OF_NUMBERS: [&str; 1] = ["channels"];
const PROTOCOLS: &str = "write protocol = \"mjpeg\", \"udp\", \"gopro\", \"iphone\" or \"remote\"";

const DEFAULT_LEASE: Duration = Duration::from_secs(3);
/// `rapid-remote` sends ten times a second.
const REMOTE_LEASE: Duration = Duration::from_secs(1);
/// Default ports: that of a GoPro's HTTP server, and the one a phone's app connects to.
const GOPRO_PORT: u16 = 8080;
const PHONE_PORT: u16 = 5555;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Word {
    Mjpeg,
    Udp,
    Gopro,
    Iphone,
    Remote,
}

impl Word {
    const WORDS: [(&str, Self); 5] = [
        ("mjpeg", Self::Mjpeg),
        ("udp", Self::Udp),
        ("gopro", Self::Gopro),
        ("iphone", Self::Iphone),
        ("remote", Self::Remote),
    ];

    fn name(self) -> &'static str {
        Self::WORDS.iter().find(|(_, word)| *word == self).map_or("", |(name, _)| name)
    }

    fn own(self) -> &'static [&'static str] {
        OWN.iter().find(|(word, _)| *word == self).map_or(&[], |(_, keys)| keys)
    }
}

/// Reads the table; `None` if a problem with it was reported.
pub(super) fn lan(section: &Section<'_>) -> Option<LanSpec> {
    section.no_tables(&["camera", "tty", "serial"], "a network device", "lan");
    if !section.is_table("lan") {
        let fix = PROTOCOLS.replacen("write", &format!("write [{}] with", section.child("lan")), 1);
        section.missing("the table of the network device", &fix);
        return None;
    }
    let table = section.table("lan")?;
    table.allow(&[&KEYS[..], &OPTIONAL].concat());
    table.need("protocol", PROTOCOLS);
    let word = table.choice("protocol", &Word::WORDS);
    let port = port(&table, "port");
    let lease = table.duration("lease", Duration::from_millis(500)..=Duration::from_mins(1));
    let word = word?;
    let lease = lease.unwrap_or(if word == Word::Remote { REMOTE_LEASE } else { DEFAULT_LEASE });
    for key in OPTIONAL.into_iter().filter(|key| table.has(key) && !word.own().contains(key)) {
        let message = format!("protocol {:?} has no {key}", word.name());
        table.report(key, message, format!("remove {key}, or correct the protocol"));
    }
    if word == Word::Remote {
        return remote(section, &table, port.unwrap_or(remote::PORT), lease);
    }
    let protocol = protocol(&table, word, port);
    let find = find(section, &table, word, port);
    Some(LanSpec { protocol: protocol?, find: find?, lease })
}

fn port(table: &Section<'_>, key: &str) -> Option<u16> {
    table.integer(key, 1..=65_535)
}

/// A device of another computer: the host is a name, and what is probed is `rapid-remote` on this one.
fn remote(section: &Section<'_>, table: &Section<'_>, port: u16, lease: Duration) -> Option<LanSpec> {
    let elsewhere = ["mdns", "instance", "probe", "probe_port"];
    for key in elsewhere.into_iter().filter(|key| table.has(key)) {
        let message = format!("a device of another computer has no {key}: rapid-remote reports when it is present");
        table.report(key, message, format!("remove {key}"));
    }
    for key in IDENTITY_KEYS.into_iter().filter(|key| section.has(key)) {
        let message = format!("{key} belongs to the device's entry on the other computer");
        section.report(key, message, format!("remove {key}; here its identity is host and device"));
    }
    table.need("host", "write host = the name that `rapid-remote serve` has on the other computer");
    let host = name(table, "host", "the name of the other computer, for example host = \"robot-b\"");
    let own = section.entry.strip_prefix("device.").unwrap_or_default();
    let device = if table.has("device") {
        name(table, "device", "the name of the device in devices.toml there, for example device = \"cam_wrist\"")
    } else {
        Some(own.to_owned())
    };
    let samples = samples(table);
    let protocol = LanProtocol::Remote { host: host?, device: device?, port, samples };
    Some(LanSpec {
        protocol,
        find: LanFind::Host { host: Ipv4Addr::LOCALHOST.into(), probe: Probe::Remote, port },
        lease,
    })
}

fn samples(table: &Section<'_>) -> RemoteSamples {
    let kind = table.choice("kind", &KINDS).unwrap_or(ModalityKind::Image);
    let (word, own): (_, &[&str]) = match kind {
        ModalityKind::Image => ("image", &OF_PICTURES),
        ModalityKind::Depth => ("depth", &OF_DEPTH),
        ModalityKind::Scalars => ("scalars", &OF_NUMBERS),
        ModalityKind::Bytes => ("bytes", &[]),
    };
    for key in [&OF_PICTURES[..], &OF_NUMBERS].concat() {
        if table.has(key) && !own.contains(&key) {
            let owner = if OF_NUMBERS.contains(&key) { "scalars" } else { "image" };
            let message = format!("samples of kind {word:?} have no {key}");
            table.report(key, message, format!("remove {key}, or write kind = {owner:?}"));
        }
    }
    match kind {
        ModalityKind::Image => {
            let format = table.choice("format", &PixelFormat::WORDS).unwrap_or(PixelFormat::Mjpg);
            RemoteSamples::Pictures(picture(table, LanPicture::OF_A_CAMERA), format)
        }
        ModalityKind::Depth => RemoteSamples::Pictures(picture(table, LanPicture::OF_A_CAMERA), PixelFormat::Z16),
        ModalityKind::Scalars => {
            table.need("channels", "write channels = the count of numbers in a sample");
            RemoteSamples::Numbers(table.integer("channels", 1..=1024).unwrap_or(1))
        }
        ModalityKind::Bytes => RemoteSamples::Bytes,
    }
}

fn name(table: &Section<'_>, key: &str, what: &str) -> Option<String> {
    let name = table.text(key)?;
    if remote::is_name(name) {
        return Some(name.to_owned());
    }
    let most = remote::LONGEST_NAME;
    let message = format!("{name:?} is no name: up to {most} letters, digits, `_` and `-` are");
    table.refuse(key, message, format!("write {what}"))
}

fn protocol(table: &Section<'_>, word: Word, port: Option<u16>) -> Option<LanProtocol> {
    Some(match word {
        // Read by `remote`.
        Word::Remote => return None,
        Word::Mjpeg => {
            let path = path(table);
            LanProtocol::Mjpeg { port, path, picture: picture(table, LanPicture::OF_A_CAMERA) }
        }
        Word::Udp => {
            table.need("port", "write port = the port of this computer that the device sends to");
            LanProtocol::Udp { port: port? }
        }
        Word::Gopro => {
            let (port, download) = (port.unwrap_or(GOPRO_PORT), table.flag("download").unwrap_or(false));
            // `reserve` is set once the whole registry is read.
            LanProtocol::Gopro { port, download, reserve: None, preview: preview(table) }
        }
        Word::Iphone => {
            const STREAMS: [(&str, PhoneStream); 2] = [("image", PhoneStream::Image), ("pose", PhoneStream::Pose)];
            let stream = table.choice("stream", &STREAMS).unwrap_or(PhoneStream::Image);
            let picture = picture(table, LanPicture::OF_A_PHONE);
            LanProtocol::Iphone { port: port.unwrap_or(PHONE_PORT), stream, picture }
        }
    })
}

/// The pictures of a GoPro, if they are its samples.
fn preview(table: &Section<'_>) -> Option<LanPicture> {
    const STREAMS: [(&str, bool); 2] = [("state", false), ("preview", true)];
    if table.choice("stream", &STREAMS).unwrap_or(false) {
        return Some(picture(table, LanPicture::OF_A_CAMERA));
    }
    for key in ["width", "height", "fps"].into_iter().filter(|key| table.has(key)) {
        let message = format!("the state of a GoPro has no {key}");
        table.report(key, message, format!("remove {key}, or write stream = \"preview\""));
    }
    None
}

fn path(table: &Section<'_>) -> String {
    /// Servers should accept at least 8000 characters (RFC 9110, 4.1); no camera's path is nearly as long.
    const LONGEST: usize = 1000;
    let Some(path) = table.text("path") else { return "/".to_owned() };
    // Characters permitted in a request line: no spaces, no control characters, only ASCII.
    if path.starts_with('/') && path.len() <= LONGEST && path.bytes().all(|b| b.is_ascii_graphic()) {
        return path.to_owned();
    }
    let fix = "begin with `/` and write what is not plain as %XX, for example path = \"/video?size=1\"";
    table.report("path", format!("{path:?} cannot be requested"), fix);
    "/".to_owned()
}

fn picture(table: &Section<'_>, default: LanPicture) -> LanPicture {
    let integer = |key, most, default| table.integer(key, 1..=most).unwrap_or(default);
    LanPicture {
        width: integer("width", 8192, default.width),
        height: integer("height", 8192, default.height),
        fps: integer("fps", 1000, default.fps),
    }
}

/// Two entries cannot use the same port of this computer, unless each does on a separate adapter.
pub(super) fn check_ports(drafts: &[Draft<'_>]) {
    for (index, draft) in drafts.iter().enumerate() {
        let Some((port, own)) = draft.lan().and_then(|lan| Some((lan.own_port()?, lan))) else { continue };
        let same = |earlier: &&Draft<'_>| {
            earlier.lan().is_some_and(|other| {
                other.own_port() == Some(port) && !(own.find.is_adapter() && other.find.is_adapter())
            })
        };
        let Some(earlier) = drafts.iter().take(index).find(same) else { continue };
        let (_, number) = port;
        let message = format!("port {number} of this computer is already used by [{}]", earlier.section.entry);
        let fix = "write another port here, and set the device to send to it";
        draft.section.report("lan", message, fix);
    }
}

/// A GoPro has one shutter, and one entry: its samples are its state or its preview.
pub(super) fn check_gopros(drafts: &[Draft<'_>]) {
    let gopro = |draft: &Draft<'_>| {
        let lan = draft.lan().filter(|lan| matches!(lan.protocol, LanProtocol::Gopro { .. }))?;
        match &lan.find {
            LanFind::Host { host, .. } => Some(*host),
            LanFind::Adapter { .. } | LanFind::Mdns { .. } => None,
        }
    };
    for (index, draft) in drafts.iter().enumerate() {
        let Some(host) = gopro(draft) else { continue };
        let Some(earlier) = drafts.iter().take(index).find(|other| gopro(other) == Some(host)) else { continue };
        let message = format!("the GoPro at {host} is [{}] already", earlier.section.entry);
        draft.section.report("lan", message, "keep one of them: stream = \"preview\" or stream = \"state\"");
    }
}

/// An announced instance belongs to one entry: another that names it would never have a device.
pub(super) fn check_instances(drafts: &[Draft<'_>]) {
    let named = |draft: &Draft<'_>| {
        let (service, instance) = draft.lan()?.find.announced()?;
        Some((service.to_ascii_lowercase(), instance?.to_ascii_lowercase()))
    };
    for (index, draft) in drafts.iter().enumerate() {
        let Some(own) = named(draft) else { continue };
        let Some(earlier) = drafts.iter().take(index).find(|other| named(other).as_ref() == Some(&own)) else {
            continue;
        };
        let message = format!("its mdns and instance are those of [{}] already", earlier.section.entry);
        draft.section.report("lan", message, "write the instance of another device, or remove one of the entries");
    }
}

/// Exactly one way: the USB identity of the entry, `mdns`, or `host`.
fn find(section: &Section<'_>, table: &Section<'_>, word: Word, port: Option<u16>) -> Option<LanFind> {
    let is_usb = IDENTITY_KEYS.iter().any(|key| section.has(key));
    let is_mdns = table.has("mdns");
    let host = host(table);
    let alone = |key: &str, owner: &str| {
        let message = format!("{key} belongs to a device that is found by {owner}");
        table.report(key, message, format!("remove {key}, or write {owner}"));
    };
    if !is_mdns && table.has("instance") {
        alone("instance", "mdns");
    }
    if is_usb || is_mdns || !table.has("host") {
        for key in ["probe", "probe_port"].into_iter().filter(|key| table.has(key)) {
            alone(key, "host");
        }
    }
    match (is_usb, is_mdns, table.has("host")) {
        (true, true, _) => {
            let message = "the entry gives two ways to find the device: by USB and by mdns".to_owned();
            table.refuse("mdns", message, "keep vid and pid for a USB network adapter, or mdns, not both")
        }
        (true, false, has_host) => {
            if word == Word::Mjpeg && !has_host {
                table.missing("host", "write host = the camera's address behind the network adapter");
            }
            if has_host { Some(LanFind::Adapter { host: Some(host?) }) } else { Some(LanFind::Adapter { host: None }) }
        }
        (false, true, true) => {
            let message = "the entry gives two ways to find the device: by mdns and by host".to_owned();
            table.refuse("host", message, "keep mdns for a device that announces itself, or host, not both")
        }
        (false, true, false) => {
            let service = service(table);
            let instance = table.text("instance").map(str::to_owned);
            Some(LanFind::Mdns { service: service?, instance })
        }
        (false, false, true) => fixed(table, host, word, port),
        (false, false, false) => {
            let fix =
                "write vid and pid of its USB network adapter, or mdns = \"_service._tcp\", or host = its address";
            table.missing("a way to find the device", fix);
            None
        }
    }
}

fn fixed(table: &Section<'_>, host: Option<IpAddr>, word: Word, port: Option<u16>) -> Option<LanFind> {
    const PROBES: [(&str, Probe); 3] = [("tcp", Probe::Tcp), ("http", Probe::Http), ("udp", Probe::Udp)];
    let default = match word {
        Word::Mjpeg | Word::Iphone => Probe::Tcp,
        Word::Remote => Probe::Remote,
        Word::Gopro => Probe::Http,
        Word::Udp => Probe::Udp,
    };
    let probe = if table.has("probe") { table.choice("probe", &PROBES) } else { Some(default) }?;
    if probe == Probe::Udp && word != Word::Udp {
        let message = format!("probe \"udp\" listens for packets, and protocol {:?} sends none", word.name());
        return table.refuse("probe", message, "write probe = \"tcp\" or \"http\"");
    }
    let own = match word {
        // That of HTTP (RFC 9110, 4.2.1).
        Word::Mjpeg => Some(port.unwrap_or(80)),
        Word::Gopro => Some(port.unwrap_or(GOPRO_PORT)),
        Word::Udp if probe == Probe::Udp => port,
        // There `port` is one of this computer.
        Word::Udp | Word::Iphone | Word::Remote => None,
    };
    if probe == Probe::Udp && table.has("probe_port") {
        let message = "probe \"udp\" listens on port".to_owned();
        return table.refuse("probe_port", message, "remove probe_port, or write probe = \"tcp\" or \"http\"");
    }
    let probed = if table.has("probe_port") { self::port(table, "probe_port") } else { own };
    if probed.is_none() && !table.has("probe_port") && (table.has("port") || word == Word::Iphone) {
        let fix = "write probe_port = a port of the device that takes connections; `port` is one of this computer";
        table.missing("probe_port", fix);
    }
    Some(LanFind::Host { host: host?, probe, port: probed? })
}

fn host(table: &Section<'_>) -> Option<IpAddr> {
    let host = table.text("host")?;
    let address = host.parse().ok().filter(|address: &IpAddr| !address.is_unspecified() && !address.is_multicast());
    if address.is_none() {
        let fix = "write its address, for example host = \"192.168.1.7\"; give the device a fixed one in your router";
        table.report("host", format!("{host:?} is not the address of a device"), fix);
    }
    address
}

/// `_name._tcp` or `_name._udp`; the name has up to 15 letters, digits and hyphens (RFC 6763, 7).
fn service(table: &Section<'_>) -> Option<String> {
    let service = table.text("mdns")?;
    let bare = service.trim_end_matches('.').trim_end_matches(".local");
    let legal = bare.split_once('.').is_some_and(|(name, transport)| {
        let name = name.strip_prefix('_').unwrap_or_default();
        (1..=15).contains(&name.len())
            && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')
            && matches!(transport, "_tcp" | "_udp")
    });
    if !legal {
        let fix =
            "write it as the device announces it, for example mdns = \"_iphonevio._tcp\"; `avahi-browse -a` lists all";
        table.report("mdns", format!("{service:?} is not a service"), fix);
    }
    legal.then(|| bare.to_owned())
}
