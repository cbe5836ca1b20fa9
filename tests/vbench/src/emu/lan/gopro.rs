//! A simulated GoPro as seen on its USB network: the HTTP interface of Open GoPro, as far as recording needs it.
//!
//! Its address is 172.2X.1YZ.51 with XYZ the last three digits of its serial number, its port 8080. A stopped clip is
//! available once it is finished, as on a real camera; until then the camera is busy.
//!
//! Invariant: every request is logged with its answer's status.

use std::net::Ipv4Addr;

use serde_json::{Value, json};

use super::http::{Body, Reply, Request};
use crate::emu::reported::Reported;

/// Port of its HTTP server.
pub const PORT: u16 = 8080;
const FOLDER: &str = "100GOPRO";
/// Time from the stop of the shutter until the clip is available.
const FINISHING_NS: u64 = 700_000_000;
/// The smallest box that identifies a file as MP4.
const HEAD: [u8; 24] = *b"\0\0\0\x18ftypmp41\0\0\0\0mp41isom";

/// The camera.
#[derive(Debug)]
pub struct Gopro {
    serial: String,
    clip_bytes: u64,
    encoding: bool,
    /// When each clip is finished; a clip's number is its index plus one.
    clips: Vec<u64>,
    reported: Vec<Reported>,
}

impl Gopro {
    /// A camera without a clip.
    pub fn new(serial: &str, megabytes: u32) -> Self {
        let clip_bytes = u64::from(megabytes) * 1_000_000;
        Self { serial: serial.into(), clip_bytes, encoding: false, clips: Vec::new(), reported: Vec::new() }
    }

    /// Its address; without three digits at the end of its serial number, zeros are used.
    pub fn address(&self) -> Ipv4Addr {
        let mut digits = self.serial.bytes().rev().map(|byte| if byte.is_ascii_digit() { byte - b'0' } else { 0 });
        let mut digit = || digits.next().unwrap_or_default();
        let (z, y, x) = (digit(), digit(), digit());
        Ipv4Addr::new(172, 20 + x, 100 + 10 * y + z, 51)
    }

    /// Answers a request.
    pub fn answer(&mut self, request: &Request, now_ns: u64) -> Reply {
        let reply = self.reply(request, now_ns);
        self.reported.push(Reported::new("http", json!({"target": request.target, "status": reply.status})));
        reply
    }

    /// Its events since the last call.
    pub fn reported(&mut self) -> impl Iterator<Item = Reported> + '_ {
        self.reported.drain(..)
    }

    fn reply(&mut self, request: &Request, now_ns: u64) -> Reply {
        let done = Reply::json(200, &json!({}));
        let refused = |status, why: &str| Reply::json(status, &json!({"error": why}));
        match request.path() {
            "/gopro/camera/control/wired_usb" => match request.query("p") {
                Some("0" | "1") => done,
                _ => refused(400, "p is 0 or 1"),
            },
            "/gopro/camera/set_date_time" => match (request.query("date"), request.query("time")) {
                (Some(_), Some(_)) => done,
                _ => refused(400, "date and time are wanted"),
            },
            "/gopro/camera/keep_alive" => done,
            "/gopro/camera/info" => Reply::json(200, &self.info()),
            "/gopro/camera/state" => Reply::json(200, &self.state(now_ns)),
            "/gopro/camera/shutter/start" => {
                self.encoding = true;
                done
            }
            "/gopro/camera/shutter/stop" => {
                if std::mem::take(&mut self.encoding) {
                    self.clips.push(now_ns + FINISHING_NS);
                }
                done
            }
            "/gopro/media/last_captured" => match self.finished(now_ns).last() {
                Some(number) => Reply::json(200, &json!({"folder": FOLDER, "file": file(number)})),
                None => refused(404, "nothing was captured"),
            },
            "/gopro/media/info" => {
                let wanted = request.query("path").and_then(|path| path.strip_prefix(FOLDER)?.strip_prefix('/'));
                match self.finished(now_ns).find(|number| Some(file(*number).as_str()) == wanted) {
                    Some(_) => Reply::json(200, &json!({"ct": "0", "cre": "0", "s": self.clip_bytes.to_string()})),
                    None => refused(404, "no such clip"),
                }
            }
            "/gopro/media/list" => {
                let all = self.finished(now_ns).map(|number| {
                    let seconds = (self.clips[number as usize - 1] / 1_000_000_000).to_string();
                    json!({"n": file(number), "cre": seconds, "mod": seconds, "s": self.clip_bytes.to_string()})
                });
                let all: Vec<Value> = all.collect();
                Reply::json(200, &json!({"id": "1", "media": [{"d": FOLDER, "fs": all}]}))
            }
            path => self.clip(path, request.from, now_ns).unwrap_or_else(|| refused(404, "no such thing")),
        }
    }

    fn clip(&self, path: &str, from: u64, now_ns: u64) -> Option<Reply> {
        let name = path.strip_prefix("/videos/DCIM/")?.strip_prefix(FOLDER)?.strip_prefix('/')?;
        let number = self.finished(now_ns).find(|number| file(*number) == name)?;
        let size = self.clip_bytes;
        Some(match from {
            0 => Reply { status: 200, body: Body::Clip { number, from, size } },
            _ if from < size => Reply { status: 206, body: Body::Clip { number, from, size } },
            _ => Reply::json(416, &json!({"error": "behind the end"})),
        })
    }

    fn finished(&self, now_ns: u64) -> impl Iterator<Item = u32> + '_ {
        (1..).zip(&self.clips).filter(move |(_, ready_ns)| **ready_ns <= now_ns).map(|(number, _)| number)
    }

    fn info(&self) -> Value {
        json!({
            "model_number": 62, "model_name": "HERO12 Black", "firmware_version": "H23.01.02.32.00",
            "serial_number": self.serial, "ap_mac_addr": "00005e005300", "ap_ssid": "bench",
        })
    }

    /// Status numbers of Open GoPro: 8 busy, 10 encoding, 35 remaining s, 54 remaining KB, 70 battery in per cent.
    fn state(&self, now_ns: u64) -> Value {
        let busy = self.encoding || self.finished(now_ns).count() != self.clips.len();
        json!({"status": {"8": u8::from(busy), "10": u8::from(self.encoding), "35": 7_200, "54": 62_000_000, "70": 87}, "settings": {}})
    }
}

fn file(number: u32) -> String {
    format!("GX01{number:04}.MP4")
}

/// Writes the bytes of clip `number` from `at` on over `out`.
pub fn clip(number: u32, at: u64, out: &mut [u8]) {
    for (byte, place) in out.iter_mut().zip(at..) {
        let head = usize::try_from(place).ok().and_then(|place| HEAD.get(place));
        // A pattern that does not repeat at a power of two, so that a reader's slip is noticed.
        *byte = head.copied().unwrap_or((place % 251) as u8 ^ (place / 251 % 253) as u8 ^ number as u8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn ask(gopro: &mut Gopro, target: &str, ms: u64) -> (u16, Value) {
        let reply = gopro.answer(&Request { target: target.into(), from: 0 }, ms * MS);
        let Body::Json(text) = &reply.body else { panic!("a clip") };
        (reply.status, serde_json::from_str(text).unwrap())
    }

    #[test]
    fn its_address_is_in_its_serial_number() {
        let address = |serial| Gopro::new(serial, 1).address().to_string();
        assert_eq!(address("C3441325012345"), "172.23.145.51");
        assert_eq!(address("C3441325012900"), "172.29.100.51");
        assert_eq!(address(""), "172.20.100.51");
    }

    #[test]
    fn a_recording() {
        let mut gopro = Gopro::new("C3441325012345", 2);
        assert_eq!(ask(&mut gopro, "/gopro/camera/control/wired_usb?p=1", 0).0, 200);
        assert_eq!(ask(&mut gopro, "/gopro/camera/control/wired_usb", 0).0, 400);
        assert_eq!(ask(&mut gopro, "/gopro/camera/info", 0).1["serial_number"], "C3441325012345");
        assert_eq!(ask(&mut gopro, "/gopro/media/last_captured", 0).0, 404);
        assert_eq!(ask(&mut gopro, "/gopro/camera/shutter/start", 0).0, 200);
        assert_eq!(ask(&mut gopro, "/gopro/camera/state", 10).1["status"]["10"], 1);
        ask(&mut gopro, "/gopro/camera/shutter/stop", 1_000);
        ask(&mut gopro, "/gopro/camera/shutter/stop", 1_001);
        let (_, state) = ask(&mut gopro, "/gopro/camera/state", 1_100);
        assert_eq!((&state["status"]["8"], &state["status"]["10"]), (&json!(1), &json!(0)));
        assert_eq!(ask(&mut gopro, "/gopro/media/last_captured", 1_699).0, 404, "not finished");
        let last = json!({"folder": "100GOPRO", "file": "GX010001.MP4"});
        assert_eq!(ask(&mut gopro, "/gopro/media/last_captured", 1_700), (200, last));
        assert_eq!(ask(&mut gopro, "/gopro/media/info?path=100GOPRO/GX010001.MP4", 1_700).1["s"], "2000000");
        assert_eq!(ask(&mut gopro, "/gopro/media/info?path=100GOPRO/GX010002.MP4", 1_700).0, 404);
        let (_, list) = ask(&mut gopro, "/gopro/media/list", 1_700);
        assert_eq!(list["media"][0]["fs"], json!([{"n": "GX010001.MP4", "cre": "1", "mod": "1", "s": "2000000"}]));
        let reported: Vec<Reported> = gopro.reported().collect();
        assert_eq!(reported.len(), 14);
        assert_eq!(reported[0].fields, json!({"target": "/gopro/camera/control/wired_usb?p=1", "status": 200}));
    }

    #[test]
    fn a_clip_is_served_from_any_byte() {
        let mut gopro = Gopro::new("1", 1);
        ask(&mut gopro, "/gopro/camera/shutter/start", 0);
        ask(&mut gopro, "/gopro/camera/shutter/stop", 0);
        let mut get = |file: &str, from| {
            gopro.answer(&Request { target: format!("/videos/DCIM/100GOPRO/{file}"), from }, 1_000 * MS)
        };
        let size = 1_000_000;
        assert_eq!(get("GX010001.MP4", 0), Reply { status: 200, body: Body::Clip { number: 1, from: 0, size } });
        assert_eq!(get("GX010001.MP4", 9), Reply { status: 206, body: Body::Clip { number: 1, from: 9, size } });
        assert_eq!(get("GX010001.MP4", size).status, 416);
        assert_eq!(get("GX010002.MP4", 0).status, 404);
        assert_eq!(get("../GX010001.MP4", 0).status, 404);
    }

    #[test]
    fn the_bytes_of_a_clip_do_not_depend_on_the_chunking() {
        let mut whole = [0; 5000];
        clip(3, 0, &mut whole);
        assert_eq!(whole[4..8], *b"ftyp");
        let mut piece = [0; 700];
        clip(3, 1234, &mut piece);
        assert_eq!(piece, whole[1234..1934]);
        let mut other = [0; 5000];
        clip(4, 0, &mut other);
        assert_ne!(whole, other);
    }
}
