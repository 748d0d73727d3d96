//! Deliveries under forged records and virtual time: the samples that each receiver received or
//! lost, and the causes. The tests construct every class and check that the sums agree.

mod causes;
mod control;
mod fates;
mod readers;
mod receivers;
mod routes;
mod settling;
