//! The border of the model, where the kernel's records become observations.

use ros2probe_model::facts::observation::Observation;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use ros2probe_wire::Record;

/// Passes a record of a complete datagram to the model. The record has wall-clock time.
pub fn observe(observer: &mut Observer, record: &Record) {
    Observation::each(record, observer.wall_clock(), |observation| {
        observer.input(Input::Observation(observation));
    });
}
