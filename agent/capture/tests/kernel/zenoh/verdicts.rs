//! Verdicts on publishers determine which of their messages are passed on.

use super::*;

fn endpoint(gid: [u8; 16]) -> ros2probe_wire::Guid {
    zerocopy::transmute!(gid)
}

#[test]
fn verdicts_on_publishers_decide_which_messages_are_passed_on() -> Result<()> {
    use ros2probe_wire::record::Verdict;
    let mut observed = Observed::new()?;
    let gids = [[1; 16], [2; 16], [3; 16], [4; 16]];
    for (gid, verdict) in gids
        .iter()
        .zip([Verdict::Ignore, Verdict::Meter, Verdict::Capture])
    {
        observed
            .filter
            .set_interest(endpoint(*gid), Some(verdict))?;
    }
    let mut connection = observed.connect("127.0.0.1:0")?;
    pass(&mut connection, true, &with_prefix(INIT))?;
    let payload = random(5, 3000);
    let mut sent = Vec::new();
    for number in 0..40_u8 {
        let batch = push(number, gids[usize::from(number % 4)], &payload);
        pass(&mut connection, true, &with_prefix(&batch))?;
        sent.push(batch);
    }
    // A publisher that is ignored sends two messages in one batch.
    let two = [
        push(40, gids[0], &payload),
        push(41, gids[0], &payload)[2..].to_vec(),
    ]
    .concat();
    pass(&mut connection, true, &with_prefix(&two))?;
    // Each publisher sends a message in fragments; the fragments have no extensions.
    let mut number = 42;
    let mut fragments = Vec::new();
    for gid in gids {
        let message = push(0, gid, &random(6, 100_000))[2..].to_vec();
        let parts: Vec<_> = message.chunks(20_000).collect();
        for (index, part) in parts.iter().enumerate() {
            let more = if index + 1 < parts.len() { 0x40 } else { 0 };
            let batch = [&[0x26 | more, number][..], part].concat();
            pass(&mut connection, true, &with_prefix(&batch))?;
            fragments.push(batch);
            number += 1;
        }
    }
    let seen = observed.seen();
    let [out, ..] = directions(&seen, &connection)?;
    let out = out.context("unseen")?;
    assert_eq!(out.gaps, 0);
    let mut batches = out.batches.iter().skip(1);
    let mut next = || batches.next().unwrap();
    for (index, sent) in sent.iter().enumerate().filter(|(index, _)| index % 4 != 0) {
        let (bytes, length) = next();
        assert_eq!(usize::from(*length), sent.len());
        assert!(sent.starts_with(bytes));
        match index % 4 {
            2 => assert_eq!(bytes.len(), sent.len(), "captured"),
            _ => assert_eq!(bytes.len(), 42 + 32, "head, and some of the payload"),
        }
    }
    assert_eq!(next().0, two);
    for (index, sent) in fragments
        .iter()
        .enumerate()
        .filter(|(index, _)| index / 6 != 0)
    {
        let (bytes, length) = next();
        assert_eq!(usize::from(*length), sent.len());
        assert!(sent.starts_with(bytes));
        match (index / 6, index % 6) {
            (2, _) => assert_eq!(bytes.len(), sent.len(), "captured: {index}"),
            (_, 0) => assert!(
                (60..=512).contains(&bytes.len()),
                "{index}: {}",
                bytes.len()
            ),
            _ => assert_eq!(bytes.len(), 14.min(sent.len()), "{index}"),
        }
    }
    assert_eq!(batches.next(), None);
    assert_eq!(observed.counter(Counter::ZenohSkipped)?, 10 + 6);
    Ok(())
}

#[test]
fn messages_over_the_budget_of_unknown_publishers_are_a_gap() -> Result<()> {
    use ros2probe_wire::record::Verdict;
    let mut observed = Observed::new()?;
    let (known, unknown) = ([1; 16], [4; 16]);
    observed
        .filter
        .set_interest(endpoint(known), Some(Verdict::Meter))?;
    let mut connection = observed.connect("127.0.0.1:0")?;
    pass(&mut connection, true, &with_prefix(INIT))?;
    let mut gaps_after = |observed: &mut Observed, batches: &[Vec<u8>]| -> Result<_> {
        for batch in batches {
            pass(&mut connection, true, &with_prefix(batch))?;
        }
        let seen = observed.seen();
        let [out, ..] = directions(&seen, &connection)?;
        let out = out.context("unseen")?;
        Ok((out.batches.len(), out.gaps))
    };
    let of_both = [push(1, unknown, &[1; 300]), push(2, known, &[2; 300])];
    assert_eq!(gaps_after(&mut observed, &of_both)?, (1 + 2, 0));
    observed
        .filter
        .set_unknown_budget(Budget::CaptureBytes, 0)?;
    assert_eq!(gaps_after(&mut observed, &of_both)?, (1, 1));
    // The fragments after the first one of such a message are left out, too.
    let message = push(0, unknown, &random(6, 50_000))[2..].to_vec();
    let fragments = message.chunks(20_000).enumerate().map(|(index, part)| {
        let more = if index < 2 { 0x40 } else { 0 };
        [&[0x26 | more, 3 + index as u8][..], part].concat()
    });
    let mut batches: Vec<_> = fragments.collect();
    batches.push(push(6, known, &[2; 300]));
    assert_eq!(gaps_after(&mut observed, &batches)?, (1, 1));
    // Messages that are not needed are no gap.
    observed
        .filter
        .set_interest(endpoint(unknown), Some(Verdict::Ignore))?;
    assert_eq!(gaps_after(&mut observed, &of_both)?, (1, 0));
    assert_eq!(observed.counter(Counter::UnknownOverBudget)?, 2);
    Ok(())
}

#[test]
fn the_programs_have_a_budget_as_soon_as_they_are_attached() -> Result<()> {
    let mut observed = Observed::with_budget(&FilterSettings::default(), None)?;
    let mut connection = observed.connect("127.0.0.1:0")?;
    pass(&mut connection, true, &with_prefix(INIT))?;
    for number in 0..100 {
        let batch = push(number, [7; 16], &[1; 300]);
        pass(&mut connection, true, &with_prefix(&batch))?;
    }
    let seen = observed.seen();
    let [out, ..] = directions(&seen, &connection)?;
    assert_eq!(out.context("unseen")?.batches.len(), 1 + 100);
    assert_eq!(observed.counter(Counter::UnknownOverBudget)?, 0);
    Ok(())
}

#[test]
fn an_ignored_publisher_is_passed_on_about_once_a_second() -> Result<()> {
    use ros2probe_wire::record::Verdict;
    let mut observed = Observed::new()?;
    observed
        .filter
        .set_interest(endpoint([1; 16]), Some(Verdict::Ignore))?;
    let mut connection = observed.connect("[::1]:0")?;
    pass(&mut connection, true, &with_prefix(INIT))?;
    let begun = std::time::Instant::now();
    for number in 0..24 {
        std::thread::sleep(std::time::Duration::from_millis(100));
        pass(
            &mut connection,
            true,
            &with_prefix(&push(number, [1; 16], &[7; 500])),
        )?;
    }
    let seconds = usize::try_from(begun.elapsed().as_secs())?;
    let seen = observed.seen();
    let [out, ..] = directions(&seen, &connection)?;
    let out = out.context("unseen")?;
    assert_eq!(out.gaps, 0);
    assert!(
        (2..=2 + seconds).contains(&out.batches.len()),
        "{}",
        out.batches.len()
    );
    Ok(())
}
