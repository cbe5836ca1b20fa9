use super::*;

#[test]
fn printed_specs_are_parsed_back() {
    let camera = DeviceSpec::uvc(0x046d, 0x0825).serial("CAM00A1").port(3).mode(Format::Mjpg, 640, 480, &[30]).mode(
        Format::Yuyv,
        320,
        240,
        &[30, 15],
    );
    let hostile = DeviceSpec::uvc(1, 2).serial("a,b=%2c\n\"'\\ \0相").names("\u{1b}[2J,", "%");
    let depth = DeviceSpec::uvc(0x8086, 0x0b07).mode(Format::Z16, 64, 48, &[15]).mode(Format::Z16, 96, 64, &[6]);
    let depth = depth.also(Format::Yuyv, 64, 48, &[15]).mode(Format::Mjpg, 64, 48, &[15, 30]);
    assert!(
        depth.to_string().ends_with(",mode=Z16-64x48@15,mode=Z16-96x64@6,also=YUYV-64x48@15,mode=MJPG-64x48@15/30")
    );
    for spec in [
        camera,
        hostile,
        depth,
        // The first camera has the default mode.
        DeviceSpec::uvc(1, 2).also(Format::Z16, 64, 48, &[15]).also(Format::Yuyv, 64, 48, &[15]),
        DeviceSpec::acm(0x2e8a, 0x000a, 100.0).serial("TOF1").feed("/tmp/bench/a,b"),
        DeviceSpec::ftdi(0x0403, 0x6001, 0.5),
        DeviceSpec::can(Protocol::GsUsb).motor(0x05, 0x15, "DMH3510").motor(0x1b, 0x2b, "DM4310"),
        DeviceSpec::can(Protocol::Slcan).serial("CAN1"),
        DeviceSpec::can(Protocol::Damiao).motor(0x01, 0x11, "DM4340"),
        DeviceSpec::ecm().serial("C3441325012345").gopro(3),
        DeviceSpec::ecm().lidar(100.0),
        DeviceSpec::gpio().serial("GPIO1"),
    ] {
        assert_eq!(spec.to_string().parse(), Ok(spec));
    }
}

#[test]
fn mistakes_are_named() {
    let cases = [
        ("cam:", "unknown kind `cam`: use uvc, acm, ftdi, gsusb, slcan, damiao, ecm or gpio"),
        ("uvc:hz=3", "unknown key `hz=3` for uvc"),
        ("acm:serial=%4", "`serial=%4`: expected text, with %25 for a per cent sign"),
        ("gsusb:motor=5/15", "`motor=5/15`: expected SLAVE/MASTER/TYPE, ids in hexadecimal, such as 5/15/DMH3510"),
        ("ecm:lidar=0", "`lidar=0`: expected 0.1 to 5000 packets a second"),
        ("acm:port=15", "`port=15`: expected a port from 0 to 14"),
        ("uvc:mode=MJPG-640@30", "`mode=MJPG-640@30`: expected FORMAT-WxH@FPS[/FPS..], FORMAT MJPG, YUYV or Z16"),
    ];
    let fifth = format!("uvc:{}also=Z16-64x48@15", "also=YUYV-64x48@15,".repeat(3));
    let cases = cases.into_iter().chain([
        ("acm:also=Z16-64x48@15", "unknown key `also=Z16-64x48@15` for acm"),
        (fifth.as_str(), "unknown key `also=Z16-64x48@15` for uvc"),
    ]);
    for (text, message) in cases {
        assert_eq!(text.parse::<DeviceSpec>().unwrap_err().to_string(), message);
    }
}
