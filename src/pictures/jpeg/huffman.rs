//! Huffman tables of a JPEG picture (ITU-T T.81, annex C and K.3), and the bits that they decode.

/// Bits by which a code is looked up; longer codes are searched.
const SHORT_BITS: u32 = 9;
/// Bits by which a code and the bits that belong to it are skipped at once.
const SKIP_BITS: u32 = 12;
/// Length of the longest code.
const LONGEST_CODE: u32 = 16;
/// Most bits of an alternating-current coefficient of 8-bit pixels (table F.2).
const MOST_AC_BITS: u8 = 10;
/// Coefficients of a block.
pub(super) const COEFFICIENTS: u32 = 64;
/// In a skip: the end of the block. More than any number of coefficients.
pub(super) const END_OF_BLOCK: u8 = 128;

/// What a table is made of: how many codes of each length there are, and their symbols by rising code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct TableSpec {
    lengths: [u8; 16],
    symbols: [u8; 256],
}

impl TableSpec {
    /// The next table of a DHT segment, behind its class and number, and the bytes behind it; `None` if it is cut short or
    /// has more codes than its lengths allow.
    pub(super) fn read(segment: &[u8]) -> Option<(Self, &[u8])> {
        let (&lengths, rest) = segment.split_first_chunk::<16>()?;
        let count = lengths.iter().map(|count| usize::from(*count)).sum();
        let (symbols, rest) = rest.split_at_checked(count)?;
        // Each length has twice the room of the shorter one, less what that has used.
        let room = lengths.iter().try_fold(1_u32, |room, count| (2 * room).checked_sub(u32::from(*count)));
        Some((Self::new(lengths, symbols)?, rest)).filter(|_| room.is_some())
    }

    /// `None` if there are more symbols than bytes have values.
    fn new(lengths: [u8; 16], symbols: &[u8]) -> Option<Self> {
        let mut all = [0; 256];
        all.get_mut(..symbols.len())?.copy_from_slice(symbols);
        Some(Self { lengths, symbols: all })
    }
}

/// A table that decodes.
#[derive(Debug)]
pub(super) struct Table {
    spec: TableSpec,
    /// By the next bits: length and symbol of a short code; 0 if there is none.
    short: Vec<(u8, u8)>,
    /// By the next bits: how many to skip, and by how many coefficients a block advances; 0 if they do not say.
    skips: Vec<(u8, u8)>,
    /// Of each length: its first code, and the place of that one's symbol.
    first: [(u32, usize); 17],
}

impl Table {
    pub(super) fn new(spec: &TableSpec) -> Self {
        let mut table = Self {
            short: vec![(0, 0); 1 << SHORT_BITS],
            skips: vec![(0, 0); 1 << SKIP_BITS],
            first: [(0, 0); 17],
            spec: *spec,
        };
        let (mut code, mut place) = (0_u32, 0);
        for (length, count) in (1_u8..).zip(table.spec.lengths) {
            code <<= 1;
            if let Some(first) = table.first.get_mut(usize::from(length)) {
                *first = (code, place);
            }
            for _ in 0..count {
                let symbol = table.spec.symbols.get(place).copied().unwrap_or_default();
                fill(&mut table.short, SHORT_BITS, code, length, (length, symbol));
                if let Some(skip) = skip(length, symbol) {
                    fill(&mut table.skips, SKIP_BITS, code, length, skip);
                }
                (code, place) = (code + 1, place + 1);
            }
        }
        table
    }

    pub(super) fn is_of(&self, spec: &TableSpec) -> bool {
        self.spec == *spec
    }

    /// The symbol of the next code; `None` if no code begins like that.
    #[inline]
    pub(super) fn symbol(&self, bits: &mut Bits<'_>) -> Option<u8> {
        bits.refill();
        let (length, symbol) = self.short.get(bits.peek(SHORT_BITS) as usize).copied().unwrap_or_default();
        if length > 0 {
            bits.skip(length.into());
            return Some(symbol);
        }
        self.long(bits)
    }

    #[cold]
    fn long(&self, bits: &mut Bits<'_>) -> Option<u8> {
        for length in SHORT_BITS + 1..=LONGEST_CODE {
            let index = length as usize;
            let (first, place) = *self.first.get(index)?;
            let above = bits.peek(length).checked_sub(first);
            let count = u32::from(*self.spec.lengths.get(index - 1)?);
            if let Some(above) = above.filter(|above| *above < count) {
                bits.skip(length);
                return self.spec.symbols.get(place + above as usize).copied();
            }
        }
        None
    }

    /// Skips an alternating-current coefficient and the zeros before it; returns by how many coefficients the block
    /// advances, [`END_OF_BLOCK`] at its end. `None` if no code begins like that, or means nothing.
    #[inline]
    pub(super) fn skip(&self, bits: &mut Bits<'_>) -> Option<u32> {
        bits.refill();
        let (length, advance) = self.skips.get(bits.peek(SKIP_BITS) as usize).copied().unwrap_or_default();
        if length > 0 {
            bits.skip(length.into());
            return Some(advance.into());
        }
        let symbol = self.symbol(bits)?;
        let (length, advance) = skip(0, symbol)?;
        bits.skip(length.into());
        Some(advance.into())
    }
}

/// Of a code of this length with this symbol: its bits and those that follow it, and the advance in the block.
fn skip(length: u8, symbol: u8) -> Option<(u8, u8)> {
    let (run, bits) = (symbol >> 4, symbol & 15);
    match (run, bits) {
        (0, 0) => Some((length, END_OF_BLOCK)),
        (15, 0) => Some((length, 16)),
        (_, 1..=MOST_AC_BITS) => Some((length + bits, run + 1)),
        _ => None,
    }
}

/// Enters a value for all bits that begin with a code.
fn fill<T: Copy>(entries: &mut [T], width: u32, code: u32, length: u8, value: T) {
    let Some(free) = width.checked_sub(length.into()) else { return };
    let from = (code << free) as usize;
    if let Some(entries) = entries.get_mut(from..from + (1 << free)) {
        entries.fill(value);
    }
}

/// The bits of one interval, whose stuffed bytes are taken out and whose end is followed by [`PADDING`] bytes.
#[derive(Debug)]
pub(super) struct Bits<'a> {
    padded: &'a [u8],
    /// Where the next bytes come from.
    next: usize,
    /// The next bits, from the highest on.
    ahead: u64,
    /// How many of these there are.
    count: u32,
}

/// Bytes behind an interval.
pub(super) const PADDING: usize = 8;

impl<'a> Bits<'a> {
    pub(super) const fn new(padded: &'a [u8]) -> Self {
        Self { padded, next: 0, ahead: 0, count: 0 }
    }

    /// At least 32 bits are ahead; behind the end these are zeros.
    #[inline]
    pub(super) fn refill(&mut self) {
        if self.count >= 32 {
            return;
        }
        if let Some(word) = self.padded.get(self.next..).and_then(|rest| rest.first_chunk::<4>()) {
            self.ahead |= u64::from(u32::from_be_bytes(*word)) << (32 - self.count);
        }
        self.next += 4;
        self.count += 32;
    }

    /// The next bits; at most 32, after a refill.
    #[inline]
    fn peek(&self, count: u32) -> u32 {
        u32::try_from(self.ahead >> (64 - count)).unwrap_or(u32::MAX)
    }

    #[inline]
    fn skip(&mut self, count: u32) {
        self.ahead <<= count;
        self.count = self.count.saturating_sub(count);
    }

    /// Takes the next bits, at most 16.
    #[inline]
    pub(super) fn take(&mut self, count: u32) -> u32 {
        self.refill();
        let taken = if count == 0 { 0 } else { self.peek(count) };
        self.skip(count);
        taken
    }

    /// How many whole bytes are left; `None` behind the end.
    pub(super) fn left(&self) -> Option<usize> {
        let ahead = usize::try_from(self.count / 8).unwrap_or(usize::MAX);
        (self.padded.len() + ahead).checked_sub(PADDING + self.next)
    }
}

/// The tables of pictures that bring none (K.3.3): of direct and alternating current, for luminance and chrominance.
pub(super) fn standard(is_ac: bool, number: usize) -> Option<TableSpec> {
    let (lengths, symbols): ([u8; 16], &[u8]) = match (is_ac, number) {
        (false, 0) => ([0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0], &DC),
        (false, 1) => ([0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0], &DC),
        (true, 0) => ([0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 0x7d], &AC_LUMINANCE),
        (true, 1) => ([0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 0x77], &AC_CHROMINANCE),
        _ => return None,
    };
    TableSpec::new(lengths, symbols)
}

const DC: [u8; 12] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];

#[rustfmt::skip]
const AC_LUMINANCE: [u8; 162] = [
    0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71, 0x14, 0x32, 0x81,
    0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72, 0x82, 0x09, 0x0a, 0x16, 0x17, 0x18,
    0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48,
    0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75,
    0x76, 0x77, 0x78, 0x79, 0x7a, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99,
    0x9a, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3,
    0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2, 0xe3, 0xe4, 0xe5,
    0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];

#[rustfmt::skip]
const AC_CHROMINANCE: [u8; 162] = [
    0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22, 0x32, 0x81, 0x08,
    0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1, 0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25,
    0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36, 0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47,
    0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74,
    0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97,
    0x98, 0x99, 0x9a, 0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
    0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe2, 0xe3, 0xe4,
    0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];
