#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ros2probe_fuzz::type_objects(bytes));
