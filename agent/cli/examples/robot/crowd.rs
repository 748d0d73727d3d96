//! Many small topics: the graph of a large robot without its sensors.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use ros2_client::{Context, Publisher, Subscription};

use crate::messages::Imu;
use crate::{advertise, bare, join, listen, node, periodic, reliable, spin};

const TOPICS_OF_A_NODE: usize = 20;
const TYPE: &str = "sensor_msgs/Imu";
const DEPTH: usize = 10;

/// Sends an Imu on each of `topics` topics, `rate` times per second, from as many nodes as needed.
pub(crate) async fn send_all(
    context: &Context,
    topics: usize,
    rate: f64,
    stop: &Arc<AtomicBool>,
) -> Result<()> {
    ensure!(topics > 0, "a crowd needs topics");
    let qos = reliable(DEPTH);
    let mut publishers: Vec<Publisher<Imu>> = Vec::new();
    for first in (0..topics).step_by(TOPICS_OF_A_NODE) {
        let mut node = node(context, &format!("/talker{first}"), bare())?;
        for number in first..topics.min(first + TOPICS_OF_A_NODE) {
            publishers.push(advertise(&mut node, &name(number), TYPE, &qos)?);
        }
        spin(&mut node)?;
    }
    crate::start::ready();
    // The topics follow one another, as if each node had its own timer.
    let sending = periodic(rate * topics as f64, stop, move |count| {
        let turn = usize::try_from(count).unwrap_or_default() % topics;
        let publisher = publishers.get(turn).context("a publisher is missing");
        publisher.is_ok_and(|publisher| publisher.publish(Imu::now()).is_ok())
    });
    tokio::task::spawn_blocking(move || join([sending])).await?
}

/// Receives the messages of [`send_all`].
pub(crate) async fn receive_all(
    context: &Context,
    topics: usize,
    stop: &Arc<AtomicBool>,
) -> Result<()> {
    let qos = reliable(DEPTH);
    for first in (0..topics).step_by(TOPICS_OF_A_NODE) {
        let mut node = node(context, &format!("/listener{first}"), bare())?;
        for number in first..topics.min(first + TOPICS_OF_A_NODE) {
            let subscription: Subscription<Imu> = listen(&mut node, &name(number), TYPE, &qos)?;
            tokio::spawn(async move { while subscription.async_take().await.is_ok() {} });
        }
        spin(&mut node)?;
    }
    crate::start::ready();
    while !stop.load(Ordering::Relaxed) {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    Ok(())
}

fn name(number: usize) -> String {
    format!("/crowd/topic{number}")
}
