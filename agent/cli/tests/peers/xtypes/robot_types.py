"""Types that no package on the test machine defines."""

from dataclasses import dataclass

from cyclonedds.idl import IdlEnum, IdlStruct, IdlUnion, annotations as A, types as T


@dataclass
@A.final
class Part(IdlStruct, typename="my_robot_msgs::msg::dds_::Part_"):
    count: T.int32
    values: T.sequence[T.float64]


@dataclass
@A.final
class Thing(IdlStruct, typename="my_robot_msgs::msg::dds_::Thing_"):
    label: str
    ok: bool
    parts: T.sequence[Part, 4]
    grid: T.array[T.uint8, 3]
    one: Part
    names: T.sequence[str]
    name: T.bounded_str[10]
    b: T.byte
    i8: T.int8
    u16: T.uint16
    i16: T.int16
    u32: T.uint32
    u64: T.uint64
    i64: T.int64
    f32: T.float32


class Mode(IdlEnum, typename="my_robot_msgs::msg::dds_::Mode_"):
    IDLE = 0
    BUSY = 1


Ticks = T.typedef["my_robot_msgs.msg.dds_.Ticks_", T.sequence[T.int32, 300]]


@dataclass
@A.appendable
class Base(IdlStruct, typename="my_robot_msgs::msg::dds_::Base_"):
    id: T.uint32


@dataclass
@A.appendable
class Derived(Base, typename="my_robot_msgs::msg::dds_::Derived_"):
    mode: Mode
    ticks: Ticks
    table: T.array[T.array[T.int16, 3], 2]


class Choice(IdlUnion, discriminator=T.int32, typename="my_robot_msgs::msg::dds_::Choice_"):
    a: T.case[1, T.int32]
    b: T.case[2, str]


@dataclass
@A.final
class Odd(IdlStruct, typename="my_robot_msgs::msg::dds_::Odd_"):
    choice: Choice
