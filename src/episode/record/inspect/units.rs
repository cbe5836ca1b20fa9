//! The units that an episode's samples come from, by its file.
//!
//! Invariant: no text of a file causes a panic; data in an unexpected format is omitted.

use serde_json::Value;

use super::super::sources::Epochs;

/// From the summary; in a file without one, from the record at its beginning and the events `opened`, each with its
/// time in seconds after the beginning.
pub(super) fn reported(summary: &str, beginning: &str, opened: Vec<(f64, String)>) -> Epochs {
    if let Ok(units) = serde_json::from_str(summary) {
        return units;
    }
    let mut units: Epochs = serde_json::from_str(beginning).unwrap_or_default();
    for (at, event) in opened {
        let Ok(Value::Object(mut epoch)) = serde_json::from_str(&event) else { continue };
        let Some(Value::String(device)) = epoch.remove("device") else { continue };
        for key in ["event", "stamp", "bit"] {
            epoch.remove(key);
        }
        epoch.insert("from_s".to_owned(), at.into());
        epoch.insert("to_s".to_owned(), Value::Null);
        units.entry(device).or_default().push(Value::Object(epoch));
    }
    units
}

/// An epoch in words, for people.
pub(super) fn words(epoch: &Value) -> Vec<String> {
    let text = |key: &str| epoch.get(key).and_then(Value::as_str);
    let seconds = |key: &str| epoch.get(key).and_then(Value::as_f64);
    let from = seconds("from_s").map_or("?".to_owned(), |from| format!("{:.1}", from.max(0.0)));
    let span = seconds("to_s").map_or_else(|| format!("from {from} s"), |to| format!("{from} to {to:.1} s"));
    let number = epoch.get("epoch").and_then(Value::as_u64).map_or("?".to_owned(), |epoch| epoch.to_string());
    let mut words = vec![format!("epoch {number}"), span];
    if let Some(address) = text("address") {
        words.extend(text("instance").map(|instance| format!("instance {instance}")));
        words.push(format!("address {address}"));
    } else {
        words.push(format!("{}:{}", text("vid").unwrap_or("?"), text("pid").unwrap_or("?")));
    }
    words.extend(text("serial").map(|serial| format!("serial {serial}")));
    words.extend(text("port").map(|port| format!("port {port}")));
    words.extend(text("firmware").map(|firmware| format!("firmware {firmware}")));
    if let Some(driver) = epoch.get("driver").filter(|driver| driver.is_object()) {
        let part = |key: &str| driver.get(key).and_then(Value::as_str).unwrap_or_default();
        words.push(format!("{} {}", part("name"), part("version")).trim_end().to_owned());
    }
    words.extend(epoch.get("format").and_then(format));
    let latency = epoch.get("latency_ns").and_then(Value::as_u64).filter(|ns| *ns > 0);
    words.extend(latency.map(|ns| format!("latency {} ms", ns as f64 / 1e6)));
    words
}

fn format(format: &Value) -> Option<String> {
    let number = |key: &str| format.get(key).and_then(Value::as_f64);
    if let Some(fourcc) = format.get("fourcc").and_then(Value::as_str) {
        // Two digits distinguish 29.97 from 30.
        let rate = number("fps").map_or(String::new(), |fps| format!(" at {} fps", (fps * 100.0).round() / 100.0));
        return Some(format!("{fourcc} {}x{}{rate}", number("width")?, number("height")?));
    }
    let baud = number("baud").map(|baud| format!("{baud} baud"));
    let channels = number("channels").filter(|count| *count > 0.0).map(|count| format!("{count} channels"));
    Some([baud, channels].into_iter().flatten().collect::<Vec<_>>().join(", ")).filter(|text| !text.is_empty())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_line_of_an_epoch_omits_unknown_fields() {
        let full = json!({
            "epoch": 2, "from_s": 6.21, "to_s": 9.0, "vid": "046d", "pid": "0825", "serial": "A", "port": "1-2",
            "firmware": "4.18", "driver": {"name": "uvcvideo", "version": "6.1.0"},
            "format": {"fourcc": "MJPG", "width": 640, "height": 480, "fps": 29.97}, "latency_ns": 36_500_000,
        });
        assert_eq!(
            words(&full).join("  "),
            "epoch 2  6.2 to 9.0 s  046d:0825  serial A  port 1-2  firmware 4.18  uvcvideo 6.1.0  MJPG 640x480 at 29.97 fps  \
             latency 36.5 ms"
        );
        let serial = json!({
            "epoch": 1, "from_s": -3.0, "to_s": null, "vid": "2e8a", "pid": "000a", "serial": null,
            "driver": {"name": "cdc_acm"}, "format": {"baud": 115_200, "channels": 3}, "latency_ns": 0,
        });
        assert_eq!(words(&serial).join("  "), "epoch 1  from 0.0 s  2e8a:000a  cdc_acm  115200 baud, 3 channels");
        let lan = json!({"epoch": 1, "from_s": 0.0, "address": "10.0.0.9:80", "instance": "phone"});
        assert_eq!(words(&lan).join("  "), "epoch 1  from 0.0 s  instance phone  address 10.0.0.9:80");
        assert_eq!(words(&json!([1])).join("  "), "epoch ?  from ? s  ?:?");
        assert_eq!(
            format(&json!({"fourcc": "GREY", "width": 8, "height": 4, "fps": 30.0})).unwrap(),
            "GREY 8x4 at 30 fps"
        );
        assert_eq!(
            format(&json!({"fourcc": "GREY", "width": 8, "height": 4, "fps": 100.0})).unwrap(),
            "GREY 8x4 at 100 fps"
        );
    }

    #[test]
    fn units_of_a_file_without_a_summary_come_from_its_events() {
        let beginning = r#"{"cam": [{"epoch": 1, "from_s": -1.0, "to_s": null}]}"#;
        let opened = r#"{"stamp": 5, "event": "opened", "device": "cam", "bit": 0, "epoch": 2, "serial": "B"}"#;
        let hostile = ["", "[]", "{\"device\": 7}", "nul"];
        let opened = hostile.into_iter().chain([opened]).map(|text| (4.5, text.to_owned())).collect();
        let units = reported("", beginning, opened);
        assert_eq!(units["cam"][1], json!({"epoch": 2, "serial": "B", "from_s": 4.5, "to_s": null}));
        assert_eq!((units.len(), units["cam"].len()), (1, 2));
        assert!(reported("{}", beginning, Vec::new()).is_empty());
        assert!(reported("7", "x", Vec::new()).is_empty());
    }
}
