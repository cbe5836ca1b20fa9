use proptest::prelude::*;

use super::*;

/// The parts parsed from a camera that sends `pieces` one after another.
fn parts(boundary: &str, largest: usize, pieces: &[&[u8]]) -> (Vec<Vec<u8>>, usize) {
    let mut parser = Multipart::new(boundary, largest).expect("a boundary");
    let (mut parts, mut malformed) = (Vec::new(), 0);
    for mut piece in pieces.iter().copied() {
        while !piece.is_empty() {
            let (taken, cut) = parser.feed(piece);
            piece = &piece[taken..];
            match cut {
                Cut::Part => parts.push(parser.part().to_vec()),
                Cut::Malformed => malformed += 1,
                Cut::Head => {}
                Cut::Open => assert!(piece.is_empty(), "stopped early"),
                Cut::End => return (parts, malformed),
            }
        }
    }
    (parts, malformed)
}

#[track_caller]
fn check(stream: &[u8], expected: &[&[u8]], malformed: usize) {
    for size in [1, 2, 3, 7, stream.len()] {
        let pieces: Vec<_> = stream.chunks(size).collect();
        let (parts, bad) = parts("frame", 64, &pieces);
        assert_eq!((parts, bad), (expected.iter().map(|part| part.to_vec()).collect(), malformed), "pieces of {size}");
    }
}

#[test]
fn lenient_variants_of_cameras_are_accepted() {
    // As in the RFC.
    check(
        b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: 3\r\n\r\nabc\r\n--frame\r\nContent-Length: 2\r\n\r\nde\r\n--frame--\r\n",
        &[b"abc", b"de"],
        0,
    );
    // A length, but no line end after the body; newlines alone; odd case; a preamble.
    check(b"hello\n----frame\ncontent-LENGTH:3\n\nabc--frame\nContent-Length: 2\n\nde", &[b"abc", b"de"], 0);
    // No length: the body may contain line ends, dashes and almost a boundary.
    check(
        b"--frame\r\n\r\na\r\n--fram\n-b--frame\r\n--frames\r\n\r\n--frame\r\n\r\nc\r\n--frame--\r\n",
        &[b"a\r\n--fram\n-b--frame\r\n--frames\r\n", b"c"],
        0,
    );
    // An empty body.
    check(b"--frame\r\nContent-Length: 0\r\n\r\n\r\n--frame\r\nContent-Length: 1\r\n\r\na", &[b"", b"a"], 0);
}

#[test]
fn a_malformed_part_loses_only_itself() {
    // Announces more than permitted.
    check(b"--frame\r\nContent-Length: 65\r\n\r\nabc\r\n--frame\r\nContent-Length: 1\r\n\r\na", &[b"a"], 1);
    check(
        b"--frame\r\nContent-Length: 99999999999999999999999\r\n\r\nabc\r\n--frame\r\n\r\na\r\n--frame\r\n",
        &[b"abc", b"a"],
        0,
    );
    // Sends more than permitted.
    let mut stream = b"--frame\r\n\r\n".to_vec();
    stream.extend([b'x'; 300]);
    stream.extend(b"\r\n--frame\r\nContent-Length: 1\r\n\r\na");
    check(&stream, &[b"a"], 1);
    // Headers without an end.
    let mut stream = b"--frame\r\n".to_vec();
    stream.extend(b"X-Header: y\r\n".repeat(LONGEST_HEAD / 10));
    stream.extend(b"\r\n--frame\r\nContent-Length: 1\r\n\r\na");
    check(&stream, &[b"a"], 1);
    // The bytes that make them too large are the next part's boundary.
    for room in 0..40 {
        let mut stream = b"--frame\r\n\r\n".to_vec();
        stream.extend([b'x'; 64 + LONGEST_LINE]);
        stream.truncate(stream.len() - room);
        stream.extend(b"\n--frame\nContent-Length: 1\r\n\r\na");
        check(&stream, &[b"a"], 1);
        let mut stream = b"--frame\n".to_vec();
        stream.extend([b'x'; LONGEST_HEAD]);
        stream.truncate(stream.len() - room);
        stream.extend(b"\n--frame\nContent-Length: 1\r\n\r\na");
        // If it fits, the boundary is a line of the head, and the rest of the head may then be too large or not.
        match room {
            0..=8 => check(&stream, &[b"a"], 1),
            9..=29 => check(&stream, &[], 1),
            _ => check(&stream, &[b"a"], 0),
        }
    }
    // A header line that is too long is ignored, wherever it is cut.
    let mut stream = b"--frame\r\nContent-Length: 1".to_vec();
    stream.extend([b' '; LONGEST_LINE]);
    stream.extend(b"2\r\n\r\nabc\r\n--frame\r\n");
    check(&stream, &[b"abc"], 0);
    // A length that is too short: the rest is skipped.
    check(b"--frame\r\nContent-Length: 2\r\n\r\nabc\r\n--frame\r\nContent-Length: 1\r\n\r\na", &[b"ab", b"a"], 0);
}

#[test]
fn a_boundary_is_announced_in_many_ways() {
    for (content_type, expected) in [
        ("multipart/x-mixed-replace;boundary=frame", Some("frame")),
        ("Multipart/X-Mixed-Replace; charset=x; Boundary=\"--frame\"", Some("--frame")),
        ("multipart/x-mixed-replace; boundary= frame ", Some("frame")),
        ("multipart/x-mixed-replace", None),
        ("multipart/x-mixed-replace; boundary=", None),
        ("image/jpeg; boundary=frame", None),
    ] {
        assert_eq!(boundary(content_type), expected, "{content_type}");
    }
    assert!(Multipart::new("--", 1).is_none());
    assert!(Multipart::new(&"x".repeat(71), 1).is_none());
}

proptest! {
    #[test]
    fn chunking_does_not_matter(bodies in prop::collection::vec(prop::collection::vec(0_u8..=255, 0..60), 1..6),
                            sized in prop::collection::vec(any::<bool>(), 6), cuts in prop::collection::vec(1_usize..40, 0..30)) {
        let mut stream = Vec::new();
        for (body, sized) in bodies.iter().zip(&sized) {
            stream.extend(b"--frame\r\n");
            if *sized {
                stream.extend(format!("Content-Length: {}\r\n", body.len()).bytes());
            }
            stream.extend(b"\r\n");
            stream.extend(body);
            stream.extend(b"\r\n");
        }
        stream.extend(b"--frame--\r\n");
        let mut pieces = Vec::new();
        let mut rest = stream.as_slice();
        for cut in &cuts {
            let (piece, after) = rest.split_at((*cut).min(rest.len()));
            pieces.push(piece);
            rest = after;
        }
        pieces.push(rest);
        let (found, malformed) = parts("frame", 64, &pieces);
        prop_assert_eq!((found, malformed), (bodies, 0));
    }

    #[test]
    fn any_bytes_are_survived(
        words in prop::collection::vec(
            prop_oneof![
                any::<u8>().prop_map(|byte| vec![byte]),
                prop::sample::select(vec!["\n", "\r\n", "--f\n", "\n---f\r\n\n", "f", "Content-Length: 3\n", "\n\n"])
                    .prop_map(|word| word.as_bytes().to_vec()),
                (1_usize..150).prop_map(|count| vec![b'x'; count]),
            ],
            0..100,
        ),
        size in 1_usize..40,
    ) {
        let stream = words.concat();
        let found = parts("f", 16, &[&stream]);
        prop_assert!(found.0.iter().all(|part| part.len() <= 16));
        prop_assert_eq!(found, parts("f", 16, &stream.chunks(size).collect::<Vec<_>>()));
    }
}

proptest! {
    #[test]
    fn a_boundary_is_found_alike_however_its_line_arrives(
        empty in prop::collection::vec(prop_oneof![Just("\r\n"), Just("\n")], 0..4),
        dashes in 2_usize..5, name in "[a-z0-9]{1,60}", end in prop_oneof![Just("\r\n"), Just("\n")], rest in any::<Vec<u8>>(),
    ) {
        let line = format!("{}{}{name}{end}", empty.concat(), "-".repeat(dashes));
        for cut in 0..line.len() {
            prop_assert_eq!(sniff(&line.as_bytes()[..cut]), Sniffed::Open, "{}", cut);
        }
        let whole = [line.as_bytes(), &rest].concat();
        prop_assert_eq!(sniff(&whole), Sniffed::Boundary(name));
    }

    #[test]
    fn a_body_without_a_boundary_is_recognised_within_a_line(bytes in any::<Vec<u8>>(), more in any::<u8>()) {
        let _ = sniff(&bytes);
        prop_assert_ne!(sniff(&[more; 1 << 10]), Sniffed::Open);
    }
}
