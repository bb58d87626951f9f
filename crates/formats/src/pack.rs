use flate2::{Compress, Compression, Crc, FlushCompress};
use rayon::prelude::*;

/// Bytes of a part; each part is compressed by one thread.
const PART_BYTES: usize = 1 << 20;
/// Compression level, 1 to 9. The arrays of an SPZ file are 1.8 % larger than at level 6, in 37 % of the time.
const COMPRESSION_LEVEL: u32 = 3;

/// One gzip stream, compressed in parts of equal size by all threads; its bytes do not depend on the number of threads.
pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut parts: Vec<&[u8]> = bytes.chunks(PART_BYTES).collect();
    if parts.is_empty() {
        parts.push(&[]);
    }
    let packed: Vec<Vec<u8>> = parts
        .par_iter()
        .enumerate()
        .map(|(i, part)| {
            let flush = if i + 1 == parts.len() {
                FlushCompress::Finish
            } else {
                FlushCompress::Sync
            };
            deflate(part, flush)
        })
        .collect();
    let mut crc = Crc::new();
    crc.update(bytes);
    // No file name, no time, unknown operating system.
    let mut stream = vec![0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 0xff];
    packed.iter().for_each(|part| stream.extend_from_slice(part));
    stream.extend(crc.sum().to_le_bytes());
    stream.extend((bytes.len() as u32).to_le_bytes());
    stream
}

/// A part of a deflate stream; it ends on a byte boundary, so that the next part can follow.
fn deflate(part: &[u8], flush: FlushCompress) -> Vec<u8> {
    let mut compress = Compress::new(Compression::new(COMPRESSION_LEVEL), false);
    let mut packed = Vec::with_capacity(part.len() / 2 + 1024);
    loop {
        let read = compress.total_in() as usize;
        let before = packed.len();
        compress
            .compress_vec(&part[read..], &mut packed, flush)
            .expect("memory only");
        // Unused space means that everything was written.
        if packed.len() < packed.capacity() || packed.len() == before && read == part.len() {
            return packed;
        }
        packed.reserve(packed.len() / 2);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::unpack::Gunzip;
    use irradia_scene::Rng;

    #[test]
    fn the_parallel_stream_is_one_gzip_stream() {
        let mut rng = Rng::new(1, 2);
        for length in [0, 1, PART_BYTES, 3 * PART_BYTES + 17] {
            // Half noise, which does not shrink, half steps, which do.
            let bytes: Vec<u8> = (0..length)
                .map(|i| {
                    if i < length / 2 {
                        rng.next_u32() as u8
                    } else {
                        (i / 1000) as u8
                    }
                })
                .collect();
            let packed = gzip(&bytes);
            let mut stream = Gunzip::new(&packed);
            assert_eq!(stream.take(length).unwrap(), bytes);
            stream.finish().unwrap();
        }
    }
}
