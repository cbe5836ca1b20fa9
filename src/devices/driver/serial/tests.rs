use proptest::prelude::*;

use super::*;

fn spec(framing: Framing, parse: Parse, channels: usize) -> SerialSpec {
    SerialSpec { baud: 115_200, framing, parse, channels }
}

/// Payloads with the number of messages lost before each, and the number lost after the last.
fn decode(spec: &SerialSpec, chunks: &[&[u8]]) -> (Vec<(Vec<u8>, u64)>, u64) {
    let mut decoder = Decoder::new(spec, 64);
    let (mut found, mut lost) = (Vec::new(), 0);
    for chunk in chunks {
        let mut rest = *chunk;
        while !rest.is_empty() {
            let (taken, outcome) = decoder.feed(rest);
            rest = &rest[taken..];
            match outcome {
                Decoded::Nothing => {}
                Decoded::Malformed => lost += 1,
                Decoded::Message => {
                    let reading = decoder.reading(Stamp(1), std::mem::take(&mut lost));
                    found.push((reading.bytes.to_vec(), reading.lost));
                }
            }
        }
    }
    (found, lost)
}

fn le(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

#[test]
fn malformed_messages_are_counted_and_the_stream_continues() {
    let (found, lost) = decode(
        &spec(Framing::Line, Parse::Csv, 2),
        &[b"9,9,9 first is partial\n1,2\n1\nx,y\n\xff\xfe\n3,4\n5,6\nbad\n"],
    );
    assert_eq!(found, [(le(&[1.0, 2.0]), 0), (le(&[3.0, 4.0]), 3), (le(&[5.0, 6.0]), 0)]);
    assert_eq!(lost, 1);
}

#[test]
fn raw_messages_are_passed_on_as_they_are() {
    let (found, _) = decode(&spec(Framing::Line, Parse::Raw, 0), &[b"\n$GPGGA,1\r\n\x01\x02\n"]);
    assert_eq!(found, [(b"$GPGGA,1".to_vec(), 0), (b"\x01\x02".to_vec(), 0)]);
}

#[test]
fn fixed_messages_find_their_boundary_again() {
    // Three bytes of garbage before messages of four: each message is lost once, not each byte.
    let (found, lost) = decode(&spec(Framing::Fixed(4), Parse::Csv, 2), &[b"#!#", b"1,2 3,4 5,6 "]);
    assert_eq!(found.last().unwrap().0, le(&[5.0, 6.0]));
    assert_eq!(found[0].1 + lost, 1);
}

#[test]
fn errors_name_the_next_step() {
    let missing = open_line(Path::new("/dev/no-such-tty"), 9_600).unwrap_err();
    assert!(matches!(missing, DriverError::Gone), "{missing:?}");
    let error = |number| read_error(&std::io::Error::from_raw_os_error(number));
    assert!(matches!(error(libc::EIO), DriverError::Gone));
    assert!(matches!(error(libc::ENODEV), DriverError::Gone));
    assert!(matches!(error(libc::ENOMEM), DriverError::Retry(_)));
    let denied = tokio_serial::Error::new(tokio_serial::ErrorKind::Io(std::io::ErrorKind::PermissionDenied), "denied");
    let denied = open_error(Path::new("/dev/null"), 9_600, &denied);
    assert!(matches!(&denied, DriverError::Fatal(text) if text.contains("dialout")), "{denied:?}");
    let busy = tokio_serial::Error::new(tokio_serial::ErrorKind::NoDevice, "busy");
    let busy = open_error(Path::new("/dev/null"), 9_600, &busy);
    assert!(matches!(&busy, DriverError::Retry(text) if text.contains("another program")), "{busy:?}");
}

proptest! {
    #[test]
    fn any_bytes_in_any_chunks_give_the_same_readings(
        bytes in prop::collection::vec(
            prop_oneof![Just(b'\n'), Just(0), Just(b','), b'0'..=b'9', any::<u8>()], 0..300),
        cuts in prop::collection::vec(0_usize..300, 0..12),
        framing in prop_oneof![Just(Framing::Line), Just(Framing::Cobs), (1_usize..9).prop_map(Framing::Fixed)],
        parse in prop_oneof![Just(Parse::Csv), Just(Parse::Json), Just(Parse::F32le), Just(Parse::Raw)],
        channels in 1_usize..3,
    ) {
        let mut cuts: Vec<usize> = cuts.into_iter().map(|at| at.min(bytes.len())).collect();
        cuts.extend([0, bytes.len()]);
        cuts.sort_unstable();
        let chunks: Vec<&[u8]> = cuts.windows(2).map(|pair| &bytes[pair[0]..pair[1]]).collect();
        let spec = spec(framing, parse, channels);
        prop_assert_eq!(decode(&spec, &chunks), decode(&spec, &[&bytes]));
    }
}
