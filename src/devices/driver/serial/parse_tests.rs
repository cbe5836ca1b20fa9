use proptest::prelude::*;

use super::*;

fn read(parse: Parse, message: &[u8], count: usize) -> Option<Vec<f64>> {
    let mut values = vec![0.0; count];
    numbers(parse, message, &mut values).then_some(values)
}

#[test]
fn csv_takes_exactly_the_configured_number_of_values() {
    assert_eq!(read(Parse::Csv, b"1, -2.5 ,3e2", 3), Some(vec![1.0, -2.5, 300.0]));
    for wrong in [&b"1,2"[..], b"1,2,3,4", b"1,2,", b"1,,3", b"1,2,x", b"", b"1;2;3", b"\xff,1,2"] {
        assert_eq!(read(Parse::Csv, wrong, 3), None, "{wrong:?}");
    }
}

#[test]
fn nan_and_infinity_are_passed_on() {
    let values = read(Parse::Csv, b"nan,inf,-inf", 3).unwrap();
    assert!(values[0].is_nan());
    assert_eq!(values[1..], [f64::INFINITY, f64::NEG_INFINITY]);
}

#[test]
fn json_arrays_hold_only_numbers_and_objects_some() {
    assert_eq!(read(Parse::Json, b" [1, -2.5, 3e2] ", 3), Some(vec![1.0, -2.5, 300.0]));
    let object = br#"{"t": 7, "name": "tof\n", "ok": true, "none": null, "raw": [9, 9], "in": {"x": 9}, "z": -1}"#;
    assert_eq!(read(Parse::Json, object, 2), Some(vec![7.0, -1.0]));
    for wrong in
        [&b"[1,2]"[..], b"[1,2,3,4]", b"[1,2,\"3\"]", b"[1,2,null]", b"[1,2,3", b"[1,2,3] 4", b"3", b"", b"[1,2,nan]"]
    {
        assert_eq!(read(Parse::Json, wrong, 3), None, "{wrong:?}");
    }
    assert_eq!(read(Parse::Json, &vec![b'['; 100_000], 3), None, "nesting is bounded");
}

#[test]
fn floats_are_little_endian() {
    let bytes = [1.5_f32.to_le_bytes(), (-2.0_f32).to_le_bytes()].concat();
    assert_eq!(read(Parse::F32le, &bytes, 2), Some(vec![1.5, -2.0]));
    assert_eq!(read(Parse::F32le, &bytes[1..], 2), None);
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200), count in 0_usize..5) {
        for parse in [Parse::Csv, Parse::Json, Parse::F32le] {
            read(parse, &bytes, count);
        }
    }

    #[test]
    fn printed_values_are_parsed_back(values in prop::collection::vec(any::<f64>().prop_filter("finite", |v| v.is_finite()), 1..20)) {
        let text = values.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
        prop_assert_eq!(read(Parse::Csv, text.as_bytes(), values.len()), Some(values.clone()));
        let json = serde_json::to_vec(&values).unwrap();
        prop_assert_eq!(read(Parse::Json, &json, values.len()), Some(values));
    }
}
