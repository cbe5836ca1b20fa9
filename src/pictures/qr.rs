//! A text as a QR code, for a terminal.
//!
//! Two modules share a character cell: half blocks stand for the light modules, so that a code is dark on light on a dark
//! terminal without any colour.

use qrcodegen::{QrCode, QrCodeEcc};

/// Light modules around the code. The standard asks for four; scanners of phones need two at most, and terminals are small.
const QUIET: i32 = 2;

/// The rows of the code, all equally wide; `None` if the text is too long for one.
pub fn half_blocks(text: &str) -> Option<Vec<String>> {
    let code = QrCode::encode_text(text, QrCodeEcc::Low).ok()?;
    let places = -QUIET..code.size() + QUIET;
    // Below an odd number of rows is nothing, which is dark: one more row of the quiet zone.
    let rows = places.clone().step_by(2).map(|y| {
        let cell = |x| match (code.get_module(x, y), code.get_module(x, y + 1)) {
            (false, false) => '█',
            (false, true) => '▀',
            (true, false) => '▄',
            (true, true) => ' ',
        };
        places.clone().map(cell).collect()
    });
    Some(rows.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_code_has_its_three_corners_and_a_quiet_zone() {
        let rows = half_blocks("http://192.168.100.200:8766/#0123456789abcdefghijkl").unwrap();
        let rows: Vec<Vec<char>> = rows.iter().map(|row| row.chars().collect()).collect();
        // Version 3: 29 modules.
        assert!(rows.len() == 17 && rows.iter().all(|row| row.len() == 33), "{rows:?}");
        let corner =
            |x: usize, y: usize| (0..4).map(|row| rows[y + row][x..x + 7].iter().collect()).collect::<Vec<String>>();
        for (x, y) in [(2, 1), (24, 1)] {
            assert_eq!(corner(x, y)[..3], [" ▄▄▄▄▄ ", " █   █ ", " █▄▄▄█ "], "{x} {y}");
        }
        assert!(rows[0].iter().chain(&rows[16]).all(|cell| *cell == '█'));
        assert!(rows.iter().all(|row| row[..2].iter().chain(&row[31..]).all(|cell| *cell == '█')));
        assert_eq!(half_blocks(&"x".repeat(3000)), None);
    }
}
