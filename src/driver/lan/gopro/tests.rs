use super::*;

#[test]
fn the_camera_is_in_the_network_of_its_host() {
    for (own, camera) in [
        ([172, 24, 106, 52], Some([172, 24, 106, 51])),
        ([172, 20, 100, 1], Some([172, 20, 100, 51])),
        ([172, 19, 100, 1], None),
        ([172, 24, 99, 1], None),
        ([10, 24, 106, 52], None),
    ] {
        let own = Ipv4Addr::from(own);
        assert_eq!(is_gopros(own).then(|| camera_of(own).octets()), camera, "{own}");
    }
}

#[test]
fn the_state_is_read_by_number() {
    let answer = br#"{"status":{"8":0,"10":1,"35":3600,"54":1000,"70":87},"settings":{}}"#;
    let state = state(answer, Stamp(1)).expect("a state");
    assert_eq!(
        serde_json::to_string(&state).expect("JSON"),
        r#"{"recording":true,"busy":false,"battery_percent":87,"card_free_kb":1000,"remaining_s":3600}"#
    );
    for answer in ["", "[]", "{}", r#"{"status":{}}"#, r#"{"status":{"10":"yes"}}"#] {
        assert_eq!(super::state(answer.as_bytes(), Stamp(1)), None, "{answer}");
    }
}

#[test]
fn a_model_is_read_of_either_firmware() {
    let plain = br#"{"model_name":"HERO11 Black","firmware_version":"H22.01.01.20.00"}"#;
    let wrapped = br#"{"info":{"model_name":"HERO9 Black"}}"#;
    assert_eq!(model(plain).as_deref(), Some("HERO11 Black, firmware H22.01.01.20.00"));
    assert_eq!(model(wrapped).as_deref(), Some("HERO9 Black"));
    assert_eq!(model(b"[]"), None);
}

#[test]
fn the_clock_is_set_to_the_second() {
    let request = clock();
    let digits = request.chars().filter(char::is_ascii_digit).count();
    assert!(request.starts_with("/gopro/camera/set_date_time?date=20") && digits >= 16, "{request}");
}

#[test]
fn a_clip_is_named_by_plain_words_alone() {
    let clip = |answer: &str| Clip::new(answer.as_bytes(), PathBuf::from("/out/ep_001.mcap"), "gopro");
    let good = clip(r#"{"folder":"100GOPRO","file":"GX010001.MP4"}"#).expect("a clip");
    assert_eq!(good.target(), PathBuf::from("/out/ep_001.gopro.GX010001.MP4"));
    for answer in [
        r#"{"folder":"100GOPRO","file":"../../etc/passwd"}"#,
        r#"{"folder":"..","file":"GX010001.MP4"}"#,
        r#"{"folder":"100GOPRO","file":".hidden"}"#,
        r#"{"folder":"100GOPRO","file":"a\nb"}"#,
        r#"{"folder":"100GOPRO","file":""}"#,
        r#"{"folder":"100GOPRO"}"#,
        "nothing",
    ] {
        assert!(clip(answer).is_err(), "{answer}");
    }
    assert_eq!(clip::size(br#"{"s":"1234"}"#), Some(1234));
    assert_eq!(clip::size(br#"{"s":1234}"#), Some(1234));
    assert_eq!(clip::size(br#"{"s":-1}"#), None);
}
