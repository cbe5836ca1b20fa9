//! `[device.NAME.lan]`.

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use rapid_core::modality::ModalityKind;
use rapid_core::remote;

use super::{LanFind, LanPicture, LanProtocol, LanSpec, PhoneStream, Probe, RemoteSamples};
use crate::keys::{About, FLAG, Key, Own, TEXT, Time, Whole, Words, keys, table, text, whole};
use crate::kinds::camera::PixelFormat;
use crate::kinds::{NodeSpec, Settings, check_samples};
use crate::parse::device::{Draft, IDENTITY_KEYS};
use crate::parse::program::Programs;
use crate::section::Section;
use crate::spec::KINDS;

pub(crate) const TABLE: Key = table("lan", "A device on the network.", || About::Table(&[LanKeys::KEYS]));
const PORT: Whole<u16> = whole(1, 65_535);
const SIDE: Whole<u32> = whole(1, 8192);
const SERVICE: Own<String> = text(service, "`\"_NAME._tcp\"` or `\"_NAME._udp\"`");
const PATH: Own<String> = text(path, "text that begins with `/`");

keys! {
    /// `[device.NAME.lan]`. The sizes of pictures are by default 640 by 480 at 30, of a phone 1920 by 1440.
    struct LanKeys {
        /// Its protocol.
        protocol: Option<Word> = Words(&Word::WORDS), need PROTOCOLS;
        /// The service that it announces.
        mdns: Option<String> = SERVICE;
        /// The instance of the service, if only one is to match.
        instance: Option<String> = TEXT, usually "any";
        /// Its address; with `remote` the name of the other computer.
        host: Option<String> = TEXT;
        /// Port of the device, or that of this computer that it sends or connects to.
        port: Option<u16> = PORT, usually "mjpeg 80 or as announced, gopro 8080, iphone 5555";
        /// How the presence of a device at a fixed address is checked.
        probe: Option<Probe> = Words(&PROBES), usually "by protocol";
        /// The port that is probed.
        probe_port: Option<u16> = PORT, usually "`port`";
        /// How long it counts as present after data was last received from it.
        lease: Option<Duration> = Time(Duration::from_millis(500), Duration::from_mins(1)), usually "`\"3s\"`, with `remote` `\"1s\"`";
        /// Of mjpeg: what is requested.
        path: String = PATH, or "/".to_owned();
        /// Width of an image, pixels.
        width: Option<u32> = SIDE, usually "by protocol";
        /// Height of an image, pixels.
        height: Option<u32> = SIDE, usually "by protocol";
        /// Images per second.
        fps: Option<u32> = whole::<u32>(1, 1000), usually "`30`";
        /// Of gopro: whether its clips are downloaded after the episode.
        download: bool = FLAG, or false;
        /// Of gopro `"state"` or `"preview"`, of iphone `"image"` or `"pose"`: what a sample is.
        stream: bool = Words(&STREAMS), within Words(streams(protocol)), usually "the first of the two", or false;
        /// Of remote: name of the device there.
        device: Option<String> = TEXT, usually "the name of the entry";
        /// Of remote: content of a sample.
        kind: ModalityKind = Words(&KINDS), or ModalityKind::Image;
        /// Of remote: pixel format of its images.
        format: PixelFormat = Words(&PixelFormat::WORDS), or PixelFormat::Mjpg;
        /// Of remote: values in a sample.
        channels: Option<u32> = whole::<u32>(1, 1024);
    }
}

const PROBES: [(&str, Probe); 3] = [("tcp", Probe::Tcp), ("http", Probe::Http), ("udp", Probe::Udp)];
/// What a sample is, each with whether it is the second choice of its protocol.
const STREAMS: [(&str, bool); 4] = [("state", false), ("preview", true), ("image", false), ("pose", true)];

const fn streams(protocol: Option<Word>) -> &'static [(&'static str, bool)] {
    match protocol {
        Some(Word::Gopro) => STREAMS.split_at(2).0,
        Some(Word::Iphone) => STREAMS.split_at(2).1,
        _ => &STREAMS,
    }
}

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

pub(crate) fn read(entry: &Section<'_>, _: Programs<'_>) -> Option<Settings> {
    lan(entry).map(|lan| (NodeSpec::Lan(lan), None))
}

/// Reads the table; `None` if a problem with it was reported.
fn lan(section: &Section<'_>) -> Option<LanSpec> {
    section.no_tables(&["camera", "tty", "serial"], "a network device", "lan");
    if !section.is_table("lan") {
        let fix = PROTOCOLS.replacen("write", &format!("write [{}] with", section.child("lan")), 1);
        section.missing("the table of the network device", &fix);
        return None;
    }
    let table = section.table("lan")?;
    let keys = LanKeys::read(&table);
    let word = keys.protocol?;
    let lease = keys.lease.unwrap_or(if word == Word::Remote { REMOTE_LEASE } else { DEFAULT_LEASE });
    for key in OPTIONAL.into_iter().filter(|key| table.has(key) && !word.own().contains(key)) {
        let message = format!("protocol {:?} has no {key}", word.name());
        table.report(key, message, format!("remove {key}, or correct the protocol"));
    }
    if word == Word::Remote {
        return remote(section, &table, &keys, lease);
    }
    let protocol = protocol(&table, word, &keys);
    let find = find(section, &table, word, &keys);
    Some(LanSpec { protocol: protocol?, find: find?, lease })
}

/// A device of another computer: the host is a name, and what is probed is `rapid-remote` on this one.
fn remote(section: &Section<'_>, table: &Section<'_>, keys: &LanKeys, lease: Duration) -> Option<LanSpec> {
    let port = keys.port.unwrap_or(remote::PORT);
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
    let host =
        name(table, "host", keys.host.as_deref(), "the name of the other computer, for example host = \"robot-b\"");
    let own = section.entry.strip_prefix("device.").unwrap_or_default();
    let device = if table.has("device") {
        name(
            table,
            "device",
            keys.device.as_deref(),
            "the name of the device in devices.toml there, for example device = \"cam_wrist\"",
        )
    } else {
        Some(own.to_owned())
    };
    let samples = samples(table, keys);
    let protocol = LanProtocol::Remote { host: host?, device: device?, port, samples };
    Some(LanSpec {
        protocol,
        find: LanFind::Host { host: Ipv4Addr::LOCALHOST.into(), probe: Probe::Remote, port },
        lease,
    })
}

fn samples(table: &Section<'_>, keys: &LanKeys) -> RemoteSamples {
    check_samples(table, keys.kind, &["width", "height", "fps", "format"]);
    match keys.kind {
        ModalityKind::Image => RemoteSamples::Pictures(picture(keys, LanPicture::OF_A_CAMERA), keys.format),
        ModalityKind::Depth => RemoteSamples::Pictures(picture(keys, LanPicture::OF_A_CAMERA), PixelFormat::Z16),
        ModalityKind::Scalars => {
            table.need("channels", "write channels = the count of values in a sample");
            RemoteSamples::Numbers(keys.channels.unwrap_or(1))
        }
        ModalityKind::Bytes => RemoteSamples::Bytes,
    }
}

fn name(table: &Section<'_>, key: &str, name: Option<&str>, what: &str) -> Option<String> {
    let name = name?;
    if remote::is_name(name) {
        return Some(name.to_owned());
    }
    let most = remote::LONGEST_NAME;
    let message = format!("{name:?} is not a name: up to {most} letters, digits, `_` and `-` are");
    table.refuse(key, message, format!("write {what}"))
}

fn protocol(table: &Section<'_>, word: Word, keys: &LanKeys) -> Option<LanProtocol> {
    let port = keys.port;
    Some(match word {
        // Read by `remote`.
        Word::Remote => return None,
        Word::Mjpeg => {
            LanProtocol::Mjpeg { port, path: keys.path.clone(), picture: picture(keys, LanPicture::OF_A_CAMERA) }
        }
        Word::Udp => {
            table.need("port", "write port = the port of this computer that the device sends to");
            LanProtocol::Udp { port: port? }
        }
        Word::Gopro => {
            // `reserve` is set once the whole registry is read.
            let (port, preview) = (port.unwrap_or(GOPRO_PORT), preview(table, keys));
            LanProtocol::Gopro { port, download: keys.download, reserve: None, preview }
        }
        Word::Iphone => {
            let stream = if keys.stream { PhoneStream::Pose } else { PhoneStream::Image };
            let picture = picture(keys, LanPicture::OF_A_PHONE);
            LanProtocol::Iphone { port: port.unwrap_or(PHONE_PORT), stream, picture }
        }
    })
}

/// The pictures of a GoPro, if they are its samples.
fn preview(table: &Section<'_>, keys: &LanKeys) -> Option<LanPicture> {
    if keys.stream {
        return Some(picture(keys, LanPicture::OF_A_CAMERA));
    }
    for key in ["width", "height", "fps"].into_iter().filter(|key| table.has(key)) {
        let message = format!("the state of a GoPro has no {key}");
        table.report(key, message, format!("remove {key}, or write stream = \"preview\""));
    }
    None
}

fn path(table: &Section<'_>, key: &str) -> Option<String> {
    /// Servers should accept at least 8000 characters (RFC 9110, 4.1); no camera's path is nearly as long.
    const LONGEST: usize = 1000;
    let path = table.text(key)?;
    // Characters permitted in a request line: no spaces, no control characters, only ASCII.
    if path.starts_with('/') && path.len() <= LONGEST && path.bytes().all(|b| b.is_ascii_graphic()) {
        return Some(path.to_owned());
    }
    let fix = "begin with `/` and write what is not plain as %XX, for example path = \"/video?size=1\"";
    table.refuse(key, format!("{path:?} cannot be requested"), fix)
}

fn picture(keys: &LanKeys, default: LanPicture) -> LanPicture {
    LanPicture {
        width: keys.width.unwrap_or(default.width),
        height: keys.height.unwrap_or(default.height),
        fps: keys.fps.unwrap_or(default.fps),
    }
}

/// Two entries cannot use the same port of this computer, unless each does on a separate adapter.
pub(crate) fn check_ports(drafts: &[Draft<'_>]) {
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
pub(crate) fn check_gopros(drafts: &[Draft<'_>]) {
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
pub(crate) fn check_instances(drafts: &[Draft<'_>]) {
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
fn find(section: &Section<'_>, table: &Section<'_>, word: Word, keys: &LanKeys) -> Option<LanFind> {
    let is_usb = IDENTITY_KEYS.iter().any(|key| section.has(key));
    let is_mdns = table.has("mdns");
    let host = host(table, keys.host.as_deref());
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
        (false, true, false) => Some(LanFind::Mdns { service: keys.mdns.clone()?, instance: keys.instance.clone() }),
        (false, false, true) => fixed(table, host, word, keys),
        (false, false, false) => {
            let fix =
                "write vid and pid of its USB network adapter, or mdns = \"_service._tcp\", or host = its address";
            table.missing("a way to find the device", fix);
            None
        }
    }
}

fn fixed(table: &Section<'_>, host: Option<IpAddr>, word: Word, keys: &LanKeys) -> Option<LanFind> {
    let port = keys.port;
    let default = match word {
        Word::Mjpeg | Word::Iphone => Probe::Tcp,
        Word::Remote => Probe::Remote,
        Word::Gopro => Probe::Http,
        Word::Udp => Probe::Udp,
    };
    let probe = if table.has("probe") { keys.probe } else { Some(default) }?;
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
    let probed = if table.has("probe_port") { keys.probe_port } else { own };
    if probed.is_none() && !table.has("probe_port") && (table.has("port") || word == Word::Iphone) {
        let fix = "write probe_port = a port of the device that takes connections; `port` is one of this computer";
        table.missing("probe_port", fix);
    }
    Some(LanFind::Host { host: host?, probe, port: probed? })
}

fn host(table: &Section<'_>, host: Option<&str>) -> Option<IpAddr> {
    let host = host?;
    let address = host.parse().ok().filter(|address: &IpAddr| !address.is_unspecified() && !address.is_multicast());
    if address.is_none() {
        let fix = "write its address, for example host = \"192.168.1.7\"; give the device a fixed one in your router";
        table.report("host", format!("{host:?} is not the address of a device"), fix);
    }
    address
}

/// `_name._tcp` or `_name._udp`; the name has up to 15 letters, digits and hyphens (RFC 6763, 7).
fn service(table: &Section<'_>, key: &str) -> Option<String> {
    let service = table.text(key)?;
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
        table.report(key, format!("{service:?} is not a service"), fix);
    }
    legal.then(|| bare.to_owned())
}
