//! Compares the code of a running process with its file, which reveals breakpoints.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::os::unix::fs::FileExt as _;
use std::path::Path;

use anyhow::{Context as _, Result};
use ros2probe_attach::library;

use super::process::Process;

/// First byte of an instruction, in memory and in the file.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Code {
    pub in_memory: u8,
    pub in_file: u8,
}

/// Reads the first instruction of the Fast DDS function that copies messages into shared memory, in
/// a process that maps this file.
pub fn at_function(process: &Process, file: &Path) -> Result<Code> {
    let entry = library::find(&File::open(file)?)?;
    at(process, file, entry.offset)
}

/// Reads the first instruction of an exported function, in a process that maps this file.
pub fn at_symbol(process: &Process, file: &Path, symbol: &str) -> Result<Code> {
    let offsets = library::functions(&File::open(file)?, &[symbol])?;
    let offset = offsets.into_iter().flatten().next();
    at(
        process,
        file,
        offset.context("the file has no such function")?,
    )
}

fn at(process: &Process, file: &Path, at: u64) -> Result<Code> {
    let file = fs::canonicalize(file)?;
    let opened = File::open(&file)?;
    let mut byte = [0];
    opened.read_exact_at(&mut byte, at)?;
    let [in_file] = byte;
    let maps = File::open(format!("/proc/{}/maps", process.pid()))?;
    let name = file.to_string_lossy();
    let address = BufReader::new(maps)
        .lines()
        .map_while(Result::ok)
        .filter(|line| line.ends_with(name.as_ref()))
        .find_map(|line| {
            let mut fields = line.split_ascii_whitespace();
            let (start, end) = fields.next()?.split_once('-')?;
            let number = |text: &str| u64::from_str_radix(text, 16).ok();
            let (start, end, offset) = (number(start)?, number(end)?, number(fields.nth(1)?)?);
            let within = at.checked_sub(offset)?;
            (within < end - start).then_some(start + within)
        });
    let address = address.context("the process does not map it")?;
    let memory = File::open(format!("/proc/{}/mem", process.pid()))?;
    memory.read_exact_at(&mut byte, address)?;
    let [in_memory] = byte;
    Ok(Code { in_memory, in_file })
}
