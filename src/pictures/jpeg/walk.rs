//! Whether a JPEG picture is whole (ITU-T T.81): its segments and its entropy-coded data are walked to their end, and no
//! pixel is computed.
//!
//! Decoders fill what is damaged with grey, or with what came before; the walk reports it. It finds data that end too
//! early or too late for the picture's size, restart markers that are missing or out of order, codes that do not exist,
//! and a brightness that no pixel has. It cannot find damage that leaves all of these as they were.
//!
//! Sequential and progressive Huffman coding of 8 bits, which is what the decoder knows. Pictures without tables have
//! those of the standard, as in motion JPEG. Bytes behind the end of a picture belong to nothing and are ignored.

use memchr::memchr;

use super::LARGEST;
use super::huffman::{Bits, COEFFICIENTS, END_OF_BLOCK, PADDING, Table, TableSpec, standard};

/// Most scans of a picture: a progressive one has about ten, and each may need no bytes for millions of blocks.
const MOST_SCANS: usize = 64;
/// Most bytes that a camera adds to an interval to fill its words, whatever they are.
const MOST_FILL: usize = 4;
/// The greatest direct-current coefficient that pixels have is 1024; encoders compute and round it differently.
const MOST_DC: i32 = 1200;

/// What a whole picture is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame {
    /// Pixels per row.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// Values of a pixel: 1 is grey.
    pub components: u8,
    /// Bytes up to its end; what follows is not part of the picture.
    pub length: usize,
}

/// Why a picture is not whole. Places are bytes from its beginning.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Damage {
    /// Something else, or the rest of a picture.
    #[error("it does not begin like a JPEG picture")]
    Beginning,
    /// The bytes end before it does.
    #[error("it has no end")]
    End,
    /// No marker where one must be.
    #[error("byte {0} is not the marker of a segment")]
    Marker(usize),
    /// A segment that contradicts itself or the others.
    #[error("the segment at byte {0} is damaged")]
    Segment(usize),
    /// A way of coding that no reader here knows.
    #[error("it is {0}, which is not supported")]
    Unsupported(&'static str),
    /// The entropy-coded data before this byte are not those of the picture.
    #[error("its data are damaged before byte {0}")]
    Data(usize),
    /// Part of it is not in the data.
    #[error("its data do not cover the picture")]
    Incomplete,
}

/// Walks pictures. Tables that are the same as in the picture before are not built again, and memory is reused: then nothing
/// allocates.
#[derive(Debug, Default)]
pub struct Walker {
    dc: [Slot; 4],
    ac: [Slot; 4],
    /// The quantisation of the direct-current coefficient.
    quantisation: [i32; 4],
    components: Vec<Component>,
    /// The bytes of an interval, without stuffing.
    interval: Vec<u8>,
    /// Of a progressive picture: the coefficients of each block that are not zero.
    nonzero: Vec<u64>,
}

#[derive(Debug, Default)]
struct Slot {
    table: Option<Table>,
    /// It was defined in this picture.
    is_defined: bool,
}

#[derive(Debug, Clone, Copy)]
struct Component {
    id: u8,
    /// Blocks of a unit, across and down.
    sampling: [usize; 2],
    quantisation: usize,
    /// Blocks that have pixels, across and down.
    blocks: [usize; 2],
    /// Blocks of all units across.
    stride: usize,
    /// Of its first block in `nonzero`.
    first: usize,
    /// The coefficients that scans had to their last bit.
    known: u64,
}

/// What the frame header says.
#[derive(Debug, Clone, Copy)]
struct Header {
    frame: Frame,
    is_progressive: bool,
    /// Units across and down.
    units: [usize; 2],
}

/// What a scan has of the coefficients.
#[derive(Debug, Clone, Copy)]
struct Spectrum {
    from: u32,
    to: u32,
    is_refined: bool,
    low: u32,
    is_progressive: bool,
}

impl Spectrum {
    /// A bit for each of its coefficients.
    fn coefficients(self) -> Option<u64> {
        let up_to = u64::MAX.checked_shr(63_u32.checked_sub(self.to)?)?;
        Some(up_to & u64::MAX.checked_shl(self.from)?)
    }
}

/// A component in a scan: its index, and its tables.
#[derive(Debug, Clone, Copy, Default)]
struct Part {
    component: usize,
    dc: usize,
    ac: usize,
    /// The last direct-current coefficient.
    last: i32,
}

impl Walker {
    /// Walks the picture at the beginning of these bytes.
    ///
    /// # Errors
    /// When it is not whole.
    pub fn walk(&mut self, bytes: &[u8]) -> Result<Frame, Damage> {
        self.begin();
        if !bytes.starts_with(&[0xff, 0xd8]) {
            return Err(Damage::Beginning);
        }
        let (mut at, mut scans, mut restart) = (2, 0, 0);
        let mut header: Option<Header> = None;
        loop {
            let (marker, after) = marker(bytes, at)?;
            match marker {
                0xd9 => {
                    let Header { frame, .. } = header.ok_or(Damage::Incomplete)?;
                    let is_covered = self.components.iter().all(|component| component.known == u64::MAX);
                    return if is_covered { Ok(Frame { length: after, ..frame }) } else { Err(Damage::Incomplete) };
                }
                0x00..=0xbf | 0xd0..=0xd8 => return Err(Damage::Marker(at)),
                _ => {}
            }
            let segment = segment(bytes, after)?;
            let damaged = Damage::Segment(at);
            at = after + 2 + segment.len();
            match marker {
                0xc0..=0xc2 if header.is_none() => header = Some(self.frame(marker == 0xc2, segment, damaged)?),
                0xc4 => self.huffman(segment).ok_or(damaged)?,
                0xc3 | 0xc5..=0xc7 | 0xcb | 0xcd..=0xcf => {
                    return Err(Damage::Unsupported("not a sequential or progressive JPEG"));
                }
                0xc9 | 0xca | 0xcc => return Err(Damage::Unsupported("arithmetic coding")),
                0xc0..=0xc2 | 0xdc | 0xde | 0xdf => return Err(damaged),
                0xdb => self.quantise(segment).ok_or(damaged)?,
                0xdd => restart = u16::from_be_bytes(*segment.first_chunk().ok_or(damaged)?).into(),
                0xda => {
                    scans += 1;
                    let header = header.as_ref().filter(|_| scans <= MOST_SCANS).ok_or(damaged)?;
                    let (mut parts, count, spectrum) = self.scan_header(header, segment).ok_or(damaged)?;
                    let parts = parts.get_mut(..count).unwrap_or_default();
                    at = self.scan(bytes, at, header, parts, spectrum, restart)?;
                }
                _ => {}
            }
        }
    }

    fn begin(&mut self) {
        self.dc.iter_mut().chain(&mut self.ac).for_each(|slot| slot.is_defined = false);
        self.quantisation = [1; 4];
        self.components.clear();
        self.nonzero.clear();
    }

    /// Takes a frame header (B.2.2).
    fn frame(&mut self, is_progressive: bool, segment: &[u8], damaged: Damage) -> Result<Header, Damage> {
        let (&[bits, h1, h0, w1, w0, components], rest) = segment.split_first_chunk().ok_or(damaged)?;
        let (height, width) = (u16::from_be_bytes([h1, h0]), u16::from_be_bytes([w1, w0]));
        if bits != 8 {
            return Err(Damage::Unsupported("not of 8 bits"));
        }
        let is_side = |side: u16| (1..=LARGEST).contains(&usize::from(side));
        if !matches!(components, 1 | 3) {
            return Err(Damage::Unsupported("neither grey nor of three colours"));
        }
        if !is_side(width) || !is_side(height) {
            return Err(damaged);
        }
        let described = rest.as_chunks::<3>().0.get(..usize::from(components)).ok_or(damaged)?;
        let samplings = || described.iter().map(|[_, sampling, _]| [sampling >> 4, sampling & 15].map(usize::from));
        let most = |axis: usize| samplings().filter_map(|sampling| sampling.get(axis).copied()).max().unwrap_or(1);
        let most = [most(0), most(1)];
        if samplings().flatten().any(|blocks| !(1..=4).contains(&blocks)) {
            return Err(damaged);
        }
        let sides = [usize::from(width), usize::from(height)];
        let units = [0, 1].map(|axis| sides[axis].div_ceil(8 * most[axis]));
        let mut first = 0;
        for (&[id, _, quantisation], sampling) in described.iter().zip(samplings()) {
            let blocks = [0, 1].map(|axis| (sides[axis] * sampling[axis]).div_ceil(most[axis]).div_ceil(8));
            let stride = units[0] * sampling[0];
            let quantisation = usize::from(quantisation);
            self.components.push(Component { id, sampling, quantisation, blocks, stride, first, known: 0 });
            first += stride * units[1] * sampling[1];
        }
        if is_progressive {
            self.nonzero.resize(first, 0);
        }
        let frame = Frame { width, height, components, length: 0 };
        Ok(Header { frame, is_progressive, units })
    }

    /// Takes Huffman tables (B.2.4.2).
    fn huffman(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((number, rest)) = segment.split_first() {
            let slots = if number >> 4 == 0 { &mut self.dc } else { &mut self.ac };
            let slot = slots.get_mut(usize::from(number & 15)).filter(|_| *number < 0x20)?;
            let (spec, rest) = TableSpec::read(rest)?;
            slot.define(&spec);
            segment = rest;
        }
        Some(())
    }

    /// Takes quantisation tables (B.2.4.1), of 8 or 16 bits.
    fn quantise(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((number, rest)) = segment.split_first() {
            let is_wide = number >> 4 == 1;
            let (values, rest) = rest.split_at_checked(if is_wide { 128 } else { 64 })?;
            let [first, second] = *values.first_chunk()?;
            let quantisation = self.quantisation.get_mut(usize::from(number & 15)).filter(|_| *number < 0x20)?;
            *quantisation = if is_wide { u16::from_be_bytes([first, second]).into() } else { first.into() };
            segment = rest;
        }
        Some(())
    }

    /// Takes a scan header (B.2.3): the components, how many these are, and their coefficients.
    fn scan_header(&mut self, header: &Header, segment: &[u8]) -> Option<([Part; 4], usize, Spectrum)> {
        let (count, rest) = segment.split_first()?;
        let count = usize::from(*count);
        let (described, rest) = rest.split_at_checked(2 * count)?;
        let &[from, to, approximation] = rest.first_chunk()?;
        let mut parts = [Part::default(); 4];
        if !(1..=4).contains(&count) {
            return None;
        }
        let (high, low) = (approximation >> 4, u32::from(approximation & 15));
        let spectrum = Spectrum {
            from: from.into(),
            to: to.into(),
            is_refined: high > 0,
            low,
            is_progressive: header.is_progressive,
        };
        let is_valid = match (header.is_progressive, from, to) {
            (false, _, _) => (from, to, approximation) == (0, 63, 0),
            (true, 0, 0) => low <= 13,
            (true, 1.., _) => from <= to && to < 64 && count == 1 && low <= 13,
            (true, 0, _) => false,
        };
        for (part, [id, tables]) in parts.iter_mut().zip(described.as_chunks::<2>().0) {
            let component = self.components.iter().position(|component| component.id == *id)?;
            *part = Part { component, dc: usize::from(tables >> 4), ac: usize::from(tables & 15), last: 0 };
            let (has_brightness, has_detail) = (from == 0 && !spectrum.is_refined, to > 0);
            (!has_brightness || self.dc.get_mut(part.dc)?.is_ready(false, part.dc)).then_some(())?;
            (!has_detail || self.ac.get_mut(part.ac)?.is_ready(true, part.ac)).then_some(())?;
            let component = self.components.get_mut(component)?;
            // A sequential picture has each component once.
            (header.is_progressive || component.known == 0).then_some(())?;
            if low == 0 {
                component.known |= spectrum.coefficients()?;
            }
        }
        is_valid.then_some((parts, count, spectrum))
    }

    /// Walks the entropy-coded data at `at`, interval by interval; returns where they end.
    fn scan(
        &mut self,
        bytes: &[u8],
        mut at: usize,
        header: &Header,
        parts: &mut [Part],
        spectrum: Spectrum,
        restart: usize,
    ) -> Result<usize, Damage> {
        let units = self.units(header, parts);
        let total = units[0] * units[1];
        let mut interval = std::mem::take(&mut self.interval);
        let (mut unit, mut number) = (0, 0);
        let walked = loop {
            let (marker_at, marker) = match unstuff(bytes, at, &mut interval) {
                Ok(end) => end,
                Err(damage) => break Err(damage),
            };
            let to = if restart == 0 { total } else { total.min(unit + restart) };
            let mut bits = Bits::new(&interval);
            for part in &mut *parts {
                part.last = 0;
            }
            if self.units_of(&mut bits, unit..to, units[0], parts, spectrum).is_none() || !ends(&bits, &interval) {
                break Err(Damage::Data(marker_at));
            }
            unit = to;
            at = marker_at;
            match (unit == total, marker) {
                // Some cameras end the last interval like the others.
                (true, 0xd0..=0xd7) if restart > 0 => break Ok(at + 2),
                (true, _) => break Ok(at),
                (false, 0xd0..=0xd7) if marker == 0xd0 + number => at += 2,
                (false, _) => break Err(Damage::Data(marker_at)),
            }
            number = (number + 1) % 8;
        };
        self.interval = interval;
        walked
    }

    /// Units across and down: of a single component its blocks, otherwise those of the frame (A.2).
    fn units(&self, header: &Header, parts: &[Part]) -> [usize; 2] {
        match parts {
            [part] => self.components.get(part.component).map_or([0, 0], |component| component.blocks),
            _ => header.units,
        }
    }

    /// Walks these units; `None` where the data are not those of a picture.
    fn units_of(
        &mut self,
        bits: &mut Bits<'_>,
        units: std::ops::Range<usize>,
        across: usize,
        parts: &mut [Part],
        spectrum: Spectrum,
    ) -> Option<()> {
        let is_single = parts.len() == 1;
        let mut run = 0;
        for unit in units {
            for part in &mut *parts {
                let component = *self.components.get(part.component)?;
                let sampling = if is_single { [1, 1] } else { component.sampling };
                for block in 0..sampling[0] * sampling[1] {
                    if !spectrum.is_progressive {
                        self.sequential(bits, part, component.quantisation)?;
                        continue;
                    }
                    let (row, column) = (unit / across.max(1), unit % across.max(1));
                    let (row, column) =
                        (row * sampling[1] + block / sampling[0], column * sampling[0] + block % sampling[0]);
                    let place = component.first + row * component.stride + column;
                    self.progressive(bits, part, &component, place, spectrum, &mut run)?;
                }
            }
            bits.left()?;
        }
        // A run of blocks without coefficients ends with its interval.
        (run == 0).then_some(())
    }

    /// A block of a sequential picture (F.2.2).
    #[inline]
    fn sequential(&self, bits: &mut Bits<'_>, part: &mut Part, quantisation: usize) -> Option<()> {
        self.brightness(bits, part, quantisation, 0)?;
        let table = self.ac.get(part.ac)?.table.as_ref()?;
        let mut coefficient = 1;
        while coefficient < COEFFICIENTS {
            coefficient += table.skip(bits)?;
        }
        (coefficient == COEFFICIENTS || coefficient >= END_OF_BLOCK.into()).then_some(())
    }

    /// A direct-current coefficient (F.2.2.1), in units of `1 << low`.
    #[inline]
    fn brightness(&self, bits: &mut Bits<'_>, part: &mut Part, quantisation: usize, low: u32) -> Option<()> {
        let length = u32::from(self.dc.get(part.dc)?.table.as_ref()?.symbol(bits)?);
        if length > 11 {
            return None;
        }
        let value = bits.take(length).cast_signed();
        let is_negative = length > 0 && value < 1 << (length - 1);
        part.last += if is_negative { value - (1 << length) + 1 } else { value };
        let quantisation = self.quantisation.get(quantisation)?;
        let most = MOST_DC + (quantisation << low);
        ((part.last << low).saturating_mul(*quantisation).abs() <= most).then_some(())
    }

    /// A block of a scan of a progressive picture (G.1.2); `run`: the blocks from this one on that have no more coefficients.
    fn progressive(
        &mut self,
        bits: &mut Bits<'_>,
        part: &mut Part,
        component: &Component,
        place: usize,
        spectrum: Spectrum,
        run: &mut u32,
    ) -> Option<()> {
        match (spectrum.from, spectrum.is_refined) {
            (0, false) => return self.brightness(bits, part, component.quantisation, spectrum.low),
            (0, true) => {
                bits.take(1);
                return Some(());
            }
            _ => {}
        }
        let table = self.ac.get(part.ac)?.table.as_ref()?;
        let nonzero = self.nonzero.get_mut(place)?;
        let mut coefficient = spectrum.from;
        while *run == 0 && coefficient <= spectrum.to {
            let symbol = table.symbol(bits)?;
            let (zeros, length) = (u32::from(symbol >> 4), u32::from(symbol & 15));
            match (zeros, length) {
                (15, 0) => coefficient = pass(bits, *nonzero, coefficient, 15, spectrum)? + 1,
                (_, 0) => *run = (1 << zeros) + bits.take(zeros),
                _ => {
                    // A refined coefficient is new with one bit: its sign.
                    (!spectrum.is_refined || length == 1).then_some(())?;
                    (length <= 10).then_some(())?;
                    bits.take(length);
                    coefficient = pass(bits, *nonzero, coefficient, zeros, spectrum)?;
                    *nonzero |= 1 << coefficient;
                    coefficient += 1;
                }
            }
        }
        if *run > 0 {
            *run -= 1;
            if spectrum.is_refined {
                let rest = Spectrum { from: coefficient, ..spectrum }.coefficients().unwrap_or(0) & *nonzero;
                (0..rest.count_ones()).for_each(|_| _ = bits.take(1));
            }
        }
        Some(())
    }
}

impl Slot {
    fn define(&mut self, spec: &TableSpec) {
        self.is_defined = true;
        if self.table.as_ref().is_none_or(|table| !table.is_of(spec)) {
            self.table = Some(Table::new(spec));
        }
    }

    /// Whether it has a table; one that the picture does not define is that of the standard.
    fn is_ready(&mut self, is_ac: bool, number: usize) -> bool {
        if !self.is_defined
            && let Some(spec) = standard(is_ac, number)
        {
            self.define(&spec);
        }
        self.is_defined
    }
}

/// The place behind `zeros` coefficients that are zero so far, from `from` on; those that are not have a bit each in a scan that
/// refines. `None` behind the last coefficient of the scan.
fn pass(bits: &mut Bits<'_>, nonzero: u64, from: u32, zeros: u32, spectrum: Spectrum) -> Option<u32> {
    let (mut at, mut left) = (from, zeros);
    while at <= spectrum.to {
        if spectrum.is_refined && nonzero >> at & 1 == 1 {
            bits.take(1);
        } else if left == 0 {
            return Some(at);
        } else {
            left -= 1;
        }
        at += 1;
    }
    None
}

/// The marker at `at`, behind its fill bytes (B.1.1.2), and where it ends.
fn marker(bytes: &[u8], at: usize) -> Result<(u8, usize), Damage> {
    let rest = bytes.get(at..).filter(|rest| !rest.is_empty()).ok_or(Damage::End)?;
    let fill = rest.iter().position(|byte| *byte != 0xff).ok_or(Damage::End)?;
    let marker = rest.get(fill).filter(|_| fill > 0).ok_or(Damage::Marker(at))?;
    Ok((*marker, at + fill + 1))
}

/// The segment whose length is at `at`, without that.
fn segment(bytes: &[u8], at: usize) -> Result<&[u8], Damage> {
    let rest = bytes.get(at..).unwrap_or_default();
    let length = rest.first_chunk().map(|length| usize::from(u16::from_be_bytes(*length))).ok_or(Damage::End)?;
    if length < 2 {
        return Err(Damage::Segment(at.saturating_sub(2)));
    }
    rest.get(2..length).ok_or(Damage::End)
}

/// Copies an interval without its stuffed bytes (F.1.2.3), with padding behind it; returns where the marker is that ends it,
/// and which.
fn unstuff(bytes: &[u8], at: usize, into: &mut Vec<u8>) -> Result<(usize, u8), Damage> {
    into.clear();
    let mut from = at;
    loop {
        let rest = bytes.get(from..).unwrap_or_default();
        let length = memchr(0xff, rest).ok_or(Damage::End)?;
        into.extend_from_slice(rest.get(..length).unwrap_or_default());
        from += length;
        let (marker, after) = marker(bytes, from)?;
        if marker != 0 {
            into.extend_from_slice(&[0; PADDING]);
            return Ok((from, marker));
        }
        // A stuffed byte: the value stays.
        into.push(0xff);
        from = after;
    }
}

/// Whether an interval has nothing but fill behind what was walked: a few bytes, or any number of equal ones.
fn ends(bits: &Bits<'_>, padded: &[u8]) -> bool {
    let Some(left) = bits.left() else { return false };
    let data = padded.get(..padded.len().saturating_sub(PADDING)).unwrap_or_default();
    let rest = data.get(data.len().saturating_sub(left)..).unwrap_or_default();
    left <= MOST_FILL || rest.iter().all(|byte| *byte == 0) || rest.iter().all(|byte| *byte == 0xff)
}

#[cfg(test)]
mod tests;
