//! Memory use of the process.

/// Peak resident memory of this process in bytes, on Linux (`VmHWM` of `/proc/self/status`); `None`
/// elsewhere.
pub fn peak_rss_bytes() -> Option<u64> {
    parse(&std::fs::read_to_string("/proc/self/status").ok()?)
}

/// The `VmHWM` line is `VmHWM:    12345 kB`, in units of 1024 bytes.
fn parse(status: &str) -> Option<u64> {
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kib.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_peak_is_read_in_bytes() {
        let status = "Name:\tsplat\nVmPeak:\t  99 kB\nVmHWM:\t    2048 kB\nVmRSS:\t 5 kB\n";
        assert_eq!(parse(status), Some(2048 * 1024));
        assert_eq!(parse("Name:\tsplat\n"), None);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_peak_covers_what_was_touched() {
        let touched = vec![1u8; 32 << 20];
        let peak = peak_rss_bytes().unwrap();
        assert!(peak > touched.iter().map(|&byte| u64::from(byte)).sum::<u64>());
    }
}
