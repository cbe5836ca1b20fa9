//! Mutations for the short run, which has no fuzzer: the ones that find most.

/// A stream of numbers that is the same in every run (splitmix64, Steele, Lea and Flood 2014).
#[derive(Debug, Clone)]
pub struct Random(pub u64);

impl Random {
    /// The next number.
    pub fn number(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    /// A number below `bound`; 0 if that is 0.
    pub fn below(&mut self, bound: usize) -> usize {
        let bound = (bound as u64).max(1);
        usize::try_from(self.number() % bound).unwrap_or(0)
    }
}

/// Bytes that formats give a meaning to.
const MEANINGFUL: [&[u8]; 20] = [
    b"\0",
    b"\n",
    b"\r\n",
    b"\"",
    b"\\",
    b"'",
    b"=",
    b"[",
    b"]]",
    b"{",
    b"#",
    b",",
    b"\xff",
    b"\xff\xd8",
    b"\x7f",
    b"\x80",
    b"\xff\xff\xff\xff\xff\xff\xff\xff",
    b"-",
    b"1e999",
    b"\xe2\x80\xae",
];

/// `seed` changed in a few places; `other` may lend a part of itself.
pub fn mutate(random: &mut Random, seed: &[u8], other: &[u8]) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..=random.below(4) {
        let at = random.below(bytes.len() + 1);
        let length = random.below(1 + random.clone().below(16)).min(bytes.len() - at);
        match random.below(8) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
            1 if at < bytes.len() => bytes[at] = random.number().to_le_bytes()[0],
            2 => drop(bytes.drain(at..at + length)),
            3 => bytes.truncate(at),
            4 => drop(bytes.splice(at..at + length, MEANINGFUL[random.below(MEANINGFUL.len())].iter().copied())),
            5 => {
                let again = bytes[at..at + length].to_vec();
                drop(bytes.splice(at..at, again));
            }
            6 => {
                let from = random.below(other.len() + 1);
                let part = &other[from..other.len().min(from + 64)];
                drop(bytes.splice(at..at, part.iter().copied()));
            }
            // A number of one to eight bytes, at a border of its width.
            _ => {
                let border = [0, 1, 0x7f, 0x80, 0xff, 0x7fff_ffff, 0xffff_ffff, u64::MAX][random.below(8)];
                let width = [1, 2, 4, 8][random.below(4)].min(bytes.len() - at);
                bytes[at..at + width].copy_from_slice(&border.to_le_bytes()[..width]);
            }
        }
    }
    bytes
}
