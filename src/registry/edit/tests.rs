//! Changes of a text, and the parts that must stay.

use proptest::prelude::*;

use super::*;

fn entry(name: &str) -> NewEntry {
    let keys = [("vid", Setting::Text("046d".into())), ("bit", Setting::Whole(3))];
    let more = [("camera.width", Setting::Typed("1280".into())), ("camera.format", Setting::Typed("MJPG".into()))];
    let keys = keys.into_iter().chain(more).map(|(key, value)| (key.to_owned(), value)).collect();
    NewEntry { name: name.into(), comments: vec!["Webcam C270".into()], keys, held_back: None }
}

#[test]
fn an_entry_is_added_at_the_end() {
    let added = "# Webcam C270\n[device.cam]\nvid = \"046d\"\nbit = 3\n\n[device.cam.camera]\nwidth = 1280\nformat = \"MJPG\"\n";
    assert_eq!(append("", &[entry("cam")]).unwrap(), added);
    assert_eq!(append("a = 1", &[entry("cam")]).unwrap(), format!("a = 1\n\n{added}"));
    let windows = append("a = 1\r\n", &[entry("cam")]).unwrap();
    assert_eq!(windows, format!("a = 1\n\n{added}").replace('\n', "\r\n"));
    let held_back = NewEntry { held_back: Some("no node".into()), ..entry("cam") };
    let text = written(&held_back).unwrap();
    assert!(text.lines().all(|line| line.starts_with('#')), "{text}");
    assert!(text.contains("# Not in use: no node\n# [device.cam]\n# vid = \"046d\"\n"), "{text}");
}

#[test]
fn the_old_name_of_a_serial_line_s_table_is_replaced_and_nothing_else() {
    for (old, new) in [
        ("[device.a]\nserial_number = \"S\"\n[device.a.serial] # here\nbaud = 1\n", Some("[device.a.tty] # here")),
        ("[device.a]\nserial = { channels = 1 } # here\n", Some("\ntty = { channels = 1 } # here")),
        ("device.a.serial = { channels = 1 }\n", Some("device.a.tty = {")),
        ("[ device . \"a\" . \"serial\" ]\n[device.b]\n[device.b.serial]\r\n", Some("[ device . \"a\" . tty ]\n")),
        // The serial number, another's table, a name that only contains it, a device of that name.
        ("[device.a]\nserial = \"S\"\n[stop.x.serial]\n[device.serial]\n[device.serial.tty]\n", None),
        ("[device.a]\nserial.baud = 1\nserial . channels = 2\n", Some("tty.baud = 1\ntty . channels = 2\n")),
        (
            "device.a.\"serial\".baud = 1\ndevice.a.serial.framing = 'line'\n",
            Some("a.tty.baud = 1\ndevice.a.tty.framing"),
        ),
        (
            "[device]\na = { vid = \"1\", serial.baud = 1, serial.channels = 3 }\n",
            Some("{ vid = \"1\", tty.baud = 1, tty.channels = 3 }"),
        ),
        // A part of it would keep the old name.
        ("[device.a]\nserial.x.b = 1\nserial.x.c = 2\n", None),
        ("[device.a.serial]\nbaud = 1\n[device.a.serial.sub]\n", None),
        ("[device.a.serial.p]\n[device.a.serial.q]\n", None),
        ("[device.a]\n\"\\u0073erial\".baud = 1\nserial.channels = 1\n", None),
        // Both names are an error already.
        ("[device.a.tty]\n[device.a.serial]\n", None),
        ("[device.a]\ntty.baud = 1\nserial.channels = 2\n", None),
        ("[device.a.serial\n", None),
        ("device = 1", None),
    ] {
        let renamed = renamed(old);
        match new {
            Some(new) => assert!(renamed.contains(new) && !renamed.contains(".serial]"), "{renamed:?}"),
            None => assert_eq!(renamed, old),
        }
        let restored = renamed.replacen("tty", "serial", usize::MAX);
        assert_eq!(restored.replace('"', ""), old.replace("tty", "serial").replace('"', ""), "{old:?}");
    }
}

#[test]
fn invalid_keys_are_refused() {
    for (first, second, reason) in [
        ("a b", "x", "write letters"),
        ("", "x", "write letters"),
        ("camera..width", "x", "write letters"),
        ("serial", "serial.baud", "is not a table"),
        ("serial.baud", "serial", "it is a table"),
        ("a\n[device.evil]\nb", "x", "write letters"),
    ] {
        let keys = [first, second].map(|key| (key.to_owned(), Setting::Text("x".into()))).to_vec();
        let error = written(&NewEntry { keys, ..entry("cam") }).unwrap_err();
        assert!(error.to_string().contains(reason), "{first:?}: {error}");
    }
}

const FILE: &str = "\
# The rig.
[rig]
name = \"a\" # here

# Kept: of the file.

# Of the left camera.
[device.left]   # this one
vid = \"1\" # its vendor
# Further keys: none

[device.left.camera]
width = 640
# height = 480

# Kept: who wrote this meant the next.

# Of the right one.
[device.right]
vid = \"2\"
camera.width = 1 # dotted
# its last words

# Kept: the end.
";

#[test]
fn an_entry_is_removed_with_its_own_comments_only() {
    let left = remove(FILE, "left").unwrap();
    assert_eq!(
        left,
        "# The rig.\n[rig]\nname = \"a\" # here\n\n# Kept: of the file.\n\n# Kept: who wrote this meant the next.\n\n\
         # Of the right one.\n[device.right]\nvid = \"2\"\ncamera.width = 1 # dotted\n# its last words\n\n# Kept: the end.\n"
    );
    assert_eq!(
        remove(&left, "right").unwrap(),
        "# The rig.\n[rig]\nname = \"a\" # here\n\n# Kept: of the file.\n\n# Kept: who wrote this meant the next.\n\n# Kept: the end.\n"
    );
    assert_eq!(remove(FILE, "up").unwrap_err(), EditError::NoEntry("up".into()));
    assert_eq!(remove("device.a.vid = \"1\"\n", "a").unwrap_err(), EditError::NoHeader("a".into()));
    assert!(matches!(remove("a = ", "a").unwrap_err(), EditError::Syntax(_)));
}

#[test]
fn added_entries_can_be_removed_again() {
    let with = append(FILE, &[entry("cam")]).unwrap();
    assert!(with.starts_with(FILE));
    assert_eq!(remove(&with, "cam").unwrap(), FILE);
}

#[test]
fn an_entry_in_two_places_is_removed_from_both() {
    let text = "[device.a]\nvid = \"1\"\n\n[device.b]\nvid = \"2\"\n\n[device.a.camera]\nwidth = 1\n";
    assert_eq!(remove(text, "a").unwrap(), "[device.b]\nvid = \"2\"\n");
}

proptest! {
    #[test]
    fn any_text_of_a_device_stays_a_value_or_a_comment(serial in any::<String>(), product in any::<String>()) {
        let keys = vec![("serial".to_owned(), Setting::Text(serial.clone()))];
        let hostile = NewEntry { name: "x".into(), comments: vec![product], keys, held_back: None };
        let text = append("[rig]\nname = \"a\"\n", &[hostile]).unwrap();
        let document: DocumentMut = text.parse().unwrap();
        prop_assert_eq!(document.as_table().len(), 2);
        prop_assert_eq!(document["device"]["x"].as_table().unwrap().len(), 1);
        prop_assert_eq!(document["device"]["x"]["serial"].as_str(), Some(serial.as_str()));
    }

    #[test]
    fn no_text_causes_a_panic(text in "[a-z\\[\\]\\.\"=# \n\r]{0,80}", name in "[a-z]{0,3}") {
        let _ = remove(&text, &name);
    }
}
