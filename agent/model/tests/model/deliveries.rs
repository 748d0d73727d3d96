//! Deliveries under forged records and virtual time: what each receiver got, what it lost, and where
//! that died. Every class by construction, and all of them adding up.

mod causes;
mod control;
mod fates;
mod receivers;
mod routes;
