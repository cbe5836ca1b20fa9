use super::*;

fn registry(latency: &str) -> Registry {
    let text = format!(
        "[device.cam]\nvid = \"046d\"\npid = \"0825\"\nserial = \"A\"\nbit = 0\nnode = \"camera\"\nlatency = \"{latency}\"\n\
         [device.cam.camera]\nwidth = 64\nheight = 48\nfps = 30\n"
    );
    Registry::parse(&text, Some("/etc/rapid/devices.toml".as_ref())).unwrap().registry
}

const ESTIMATE: Estimate =
    Estimate { latency_ms: 48.26, uncertainty_ms: 0.83, correlation: 0.987, contrast: 131.4, pictures: 571, flips: 57 };

fn printed(estimate: Estimate, light: &Chosen, delay_ms: u64, current: &str) -> String {
    let registry = registry(current);
    let spec = &registry.devices[0];
    let mut out = Vec::new();
    let measured = Measured::new(spec, light, Duration::from_millis(delay_ms), estimate);
    measured.print(&registry, spec, &mut out).unwrap();
    String::from_utf8(out).unwrap()
}

#[test]
fn the_result_names_what_it_includes_and_the_line_to_write() {
    assert_eq!(
        printed(ESTIMATE, &Chosen::Terminal, 0, "0ms"),
        "cam: latency 48.3 ms ± 0.8 ms (95 %)\n  \
           571 pictures, 57 changes of the light\n  \
           correlation 0.99, contrast 131 of 255\n  \
           It includes the latency of the terminal and its screen, often 10 to 40 ms. Give it\n  \
           with --light-delay if you know it, or avoid it with --led.\n\n\
         In /etc/rapid/devices.toml, under [device.cam]:\n\n    \
             latency = \"48ms\"\n"
    );
    let led = Chosen::from_option(Some("ACT".as_ref())).unwrap();
    assert!(matches!(&led, Chosen::Led(folder) if folder.as_os_str() == "/sys/class/leds/ACT"));
    let text = printed(ESTIMATE, &led, 0, "36500us");
    assert!(
        text.contains("the latency of the LED") && text.contains("latency = \"48ms\"  # instead of 36.5ms\n"),
        "{text}"
    );
}

#[test]
fn the_delay_of_the_light_is_subtracted_and_a_negative_latency_becomes_zero() {
    let text = printed(ESTIMATE, &Chosen::Terminal, 15, "0ms");
    assert!(
        text.contains("latency 33.3 ms") && text.contains("15.0 ms of the light") && text.contains("\"33ms\""),
        "{text}"
    );
    let text = printed(ESTIMATE, &Chosen::Terminal, 60, "0ms");
    assert!(text.contains("latency -11.7 ms") && text.contains("Below zero: ") && text.contains("= \"0ms\""), "{text}");
}
