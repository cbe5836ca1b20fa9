//! Reading the registry and the mask layout of `rapid_driver`, for importing their devices.
//!
//! `registry.toml` is a list of `[[device]]` with `name`, `backend` (`usb`, the default, or `mdns`),
//! `vid`, `pid`, `serial`, `service_type` and shell commands; every value is text and may be empty.
//! `mask_layout.toml` has `device_order = [names]`, whose index is the bit. (`aod321/rapid_driver`,
//! `src/registry.rs` and `src/mask/layout.rs`.)
//!
//! Invariant: no text causes a panic; all problems of a text are reported at once.

use std::path::Path;

use super::diagnostic::RegistryErrors;
use super::section::{Section, file_label, read};
use super::spec::Hooks;

/// A `[[device]]` of `rapid_driver`.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Foreign {
    /// Its name, which may be invalid here.
    pub name: String,
    /// USB vendor and product id, if it is found by USB.
    pub usb: Option<(u16, u16)>,
    /// Serial number.
    pub serial: Option<String>,
    /// Service type, if it is found by mDNS.
    pub service: Option<String>,
    /// Shell commands: key and command.
    pub commands: Vec<(&'static str, String)>,
}

/// Reads a `registry.toml`; `path` names it in messages.
///
/// # Errors
/// All problems of the text.
pub fn devices(text: &str, path: &Path) -> Result<Vec<Foreign>, RegistryErrors> {
    let label = file_label(Some(path), "");
    read(&label, text, |root| {
        let wrong = |message: &str, fix: &str| Err(RegistryErrors::whole_file(label.clone(), message, fix));
        if root.is_table("device") {
            let fix = "it has [device.NAME] tables, as a devices.toml of rapid: use it with --config";
            return wrong("this is not a registry of rapid_driver", fix);
        }
        if !root.has("device") {
            let fix = "it lists devices as [[device]]; its usual place is ~/.config/rapid_driver/registry.toml";
            return wrong("no [[device]] in it", fix);
        }
        Ok(root.tables("device").unwrap_or_default().iter().map(device).collect())
    })
}

fn device(section: &Section<'_>) -> Foreign {
    let text = |key: &str| {
        let value = section.text(key).map(str::to_owned);
        value.filter(|text| !text.is_empty())
    };
    let backend = text("backend");
    let mut found = Foreign {
        name: text("name").unwrap_or_default(),
        serial: text("serial"),
        service: text("service_type"),
        commands: Hooks::KEYS.into_iter().filter_map(|key| Some((key, text(key)?))).collect(),
        usb: None,
    };
    let has_ids = text("vid").is_some() || text("pid").is_some();
    if found.name.is_empty() {
        section.missing("name", "write name = \"...\"");
    }
    match backend.as_deref() {
        None | Some("usb") => {
            found.service = None;
            for key in ["vid", "pid"] {
                section.need(key, "write the four hexadecimal digits that lsusb shows");
            }
            if has_ids {
                let ids = (section.usb_id("vid"), section.usb_id("pid"));
                found.usb = ids.0.zip(ids.1);
            }
        }
        Some("mdns") if found.service.is_none() => {
            section.missing("service_type", "write service_type = \"_name._tcp\"");
        }
        Some("mdns") => {}
        Some(other) => {
            let message = format!("unknown backend {other:?}");
            section.report("backend", message, "write \"usb\" or \"mdns\"");
        }
    }
    found
}

/// Reads a `mask_layout.toml`: names in the order of their bits.
///
/// # Errors
/// All problems of the text.
pub fn layout(text: &str, path: &Path) -> Result<Vec<String>, RegistryErrors> {
    let label = file_label(Some(path), "");
    read(&label, text, |root| {
        if !root.has("device_order") {
            let fix = "it has device_order = [\"name of bit 0\", \"name of bit 1\", ...]";
            return Err(RegistryErrors::whole_file(label.clone(), "no device_order in it", fix));
        }
        Ok(root.texts("device_order").unwrap_or_default())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATH: &str = "registry.toml";

    #[test]
    fn devices_are_read() {
        let text = "[[device]]\nname = \"cam_left\"\nvid = \"046d\"\npid = \"082d\"\nserial = \"ABC\"\n\
            on_attach = \"python3 cam.py --dev $DEVICE_NODE\"\non_detach = \"\"\n\n\
            [[device]]\nname = \"iPhone\"\nbackend = \"mdns\"\nservice_type = \"_iphonevio._tcp\"\nsensor_type = \"pose\"\n";
        let found = devices(text, Path::new(PATH)).unwrap();
        assert_eq!(found.len(), 2);
        assert_eq!((found[0].usb, found[0].serial.as_deref()), (Some((0x046d, 0x082d)), Some("ABC")));
        assert_eq!(found[0].commands, [("on_attach", "python3 cam.py --dev $DEVICE_NODE".to_owned())]);
        assert_eq!((found[1].usb, found[1].service.as_deref()), (None, Some("_iphonevio._tcp")));
        assert_eq!(layout("device_order = [\"a\", \"b\"]", Path::new(PATH)).unwrap(), ["a", "b"]);
    }

    #[test]
    fn errors_are_named_with_their_place() {
        for (text, expected) in [
            ("", "no [[device]] in it"),
            ("[device.cam]\nvid = \"1\"\n", "this is not a registry of rapid_driver"),
            ("[[device]]\nvid = \"1\"\npid = \"2\"\n", "registry.toml:1:1: [device 1] name is missing"),
            ("[[device]]\nname = \"a\"\n", "[device 1] vid is missing"),
            (
                "[[device]]\nname = \"a\"\nvid = \"xyz\"\npid = \"1\"\n",
                "registry.toml:3:7: [device 1] vid = \"xyz\" is not",
            ),
            ("[[device]]\nname = \"a\"\nbackend = \"ble\"\n", "unknown backend \"ble\""),
            ("[[device]]\nname = \"a\"\nbackend = \"mdns\"\n", "service_type is missing"),
            ("device = 3\n", "device must be a list of tables"),
            ("[[device]\n", "not TOML"),
        ] {
            let error = devices(text, Path::new(PATH)).unwrap_err().to_string();
            assert!(error.contains(expected), "{text:?}: {error}");
        }
        for (text, expected) in
            [("", "no device_order"), ("device_order = 3", "must be a list"), ("device_order = [1]", "text")]
        {
            let error = layout(text, Path::new(PATH)).unwrap_err().to_string();
            assert!(error.contains(expected), "{text:?}: {error}");
        }
    }
}
