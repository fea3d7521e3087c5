"""Features and formulas: against Python's own arithmetic, the standard body's evaluator, and random input."""

import contextlib
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from acquisition.errors import AcquisitionError, ProtocolError, SettingError
from acquisition.genicam import Features, Formula
from acquisition.twins.camera import CameraTwin


class Memory:
    """Registers of 4 KiB."""

    def __init__(self, size=4096):
        self.bytes = bytearray(size)

    def read(self, address, count):
        if address + count > len(self.bytes):
            raise ProtocolError("beyond")
        return bytes(self.bytes[address : address + count])

    def write(self, address, data):
        self.read(address, len(data))
        self.bytes[address : address + len(data)] = data


def features(body, memory=None):
    text = f'<RegisterDescription xmlns="http://www.genicam.org/GenApi/Version_1_1">{body}</RegisterDescription>'
    return Features(text.encode(), memory or Memory())


def register(name, address, length=4, extra="", tag="IntReg", access="RW"):
    return (f'<{tag} Name="{name}"><Address>{address}</Address><Length>{length}</Length>'
            f"<AccessMode>{access}</AccessMode><pPort>Device</pPort>{extra}</{tag}>")  # fmt: skip


@pytest.mark.parametrize(("text", "value"), [
    ("1 + 2 * 3", 7), ("(1 + 2) * 3", 9), ("2 ** 3 ** 2", 512), ("-2 ** 2", -4), ("7 / 2", 3), ("-7 / 2", -3),
    ("-7 % 3", -1), ("1 << 4 | 3", 19), ("6 & 3 ^ 1", 3), ("1 = 1 && 2 <> 2", 0), ("0 || 3 > 2", 1), ("~0 & 0xFF", 255),
    ("3 > 2 ? 10 : 20", 10), ("0 ? 1 : 0 ? 2 : 3", 3), ("ABS(-5) + SGN(-2)", 4), ("0x10 - 020", -4), ("!5", 0),
    ("0x7FFFFFFFFFFFFFFF + 1", -(2**63)), ("1 << 63", -(2**63)), ("10 >> 1", 5), ("- - 3", 3),
])  # fmt: skip
def test_whole_formulas(text, value):
    assert Formula(text, whole=True)({}) == value


@pytest.mark.parametrize(("text", "value"), [
    ("7 / 2", 3.5), ("SQRT(2)", math.sqrt(2)), ("LN(E)", 1), ("LG(1000)", 3), ("SIN(PI / 2)", 1), ("ROUND(2.5)", 3),
    ("ROUND(-2.5)", -3), ("ROUND(1.2345, 2)", 1.23), ("TRUNC(-1.5)", -1), ("FLOOR(-1.5)", -2), ("CEIL(1.1)", 2),
    ("1.5e3 + .5", 1500.5), ("EXP(0)", 1), ("ATAN(1) * 4", math.pi), ("7.5 % 2", 1.5), ("2 ** -1", 0.5), ("NEG(3)", -3),
])  # fmt: skip
def test_real_formulas(text, value):
    assert Formula(text)({}) == pytest.approx(value)


@pytest.mark.parametrize("text", ["", "1 +", "(1", "1)", "1 2", "a b", "SIN()", "SIN(1,2)", "ROUND(1,2,3)", "1 ? 2",
                                  "__import__('os')", "$", "1;2", "a[0]", "(" * 500 + "1" + ")" * 500, "-" * 5000 + "1",
                                  "1+" * 3000 + "1"])  # fmt: skip
def test_what_is_no_formula_is_refused(text):
    with pytest.raises(ProtocolError):
        Formula(text)


@pytest.mark.parametrize("text", ["1 / 0", "X", "SQRT(-1)", "LN(0)", "EXP(10000)", "1 << 70", "10 ** 400", "7 % 0"])
def test_values_that_do_not_exist_are_errors(text):
    with pytest.raises(ProtocolError):
        Formula(text)({})


numbers = st.integers(-(2**31), 2**31)


@given(st.recursive(
    numbers.map(lambda n: (f"({n})" if n < 0 else str(n), n)),
    lambda inner: st.tuples(st.sampled_from("+-*&|^"), inner, inner).map(
        lambda t: (f"({t[1][0]} {t[0]} {t[2][0]})",
                   {"+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b, "&": lambda a, b: a & b,
                    "|": lambda a, b: a | b, "^": lambda a, b: a ^ b}[t[0]](t[1][1], t[2][1]))
    ), max_leaves=12))  # fmt: skip
def test_whole_arithmetic_is_that_of_64_bits(pair):
    text, value = pair
    wrapped = (value + (1 << 63)) % (1 << 64) - (1 << 63)
    assert Formula(text, whole=True)({}) == wrapped


def test_registers_of_every_kind():
    memory = Memory()
    tree = features(
        register("A", 0, extra="<Sign>Signed</Sign>") + register("B", 4, 2, "<Endianess>BigEndian</Endianess>")
        + register("Low", 8, extra="<LSB>4</LSB><MSB>7</MSB>", tag="MaskedIntReg")
        + register("Flag", 8, extra="<Bit>31</Bit>", tag="MaskedIntReg")
        + register("HighBits", 12, 2, "<LSB>15</LSB><MSB>12</MSB><Endianess>BigEndian</Endianess>", "MaskedIntReg")
        + register("F", 16, 4, tag="FloatReg") + register("D", 24, 8, "<Endianess>BigEndian</Endianess>", "FloatReg")
        + register("S", 32, 8, tag="StringReg") + '<Boolean Name="On"><pValue>Flag</pValue></Boolean>'
        + '<Integer Name="Index"><Value>2</Value></Integer>'
        + register("Array", 64, 4, '<pIndex Offset="0x10">Index</pIndex>'),
        memory,
    )  # fmt: skip
    for name, value in (("A", -5), ("B", 0xABCD), ("Low", 9), ("F", 1.5), ("D", -2.25), ("S", "abc"), ("On", True),
                        ("HighBits", 5), ("Array", 77)):  # fmt: skip
        tree.set(name, value)
        assert tree.get(name) == value
    assert memory.bytes[:4] == (-5).to_bytes(4, "little", signed=True)
    assert memory.bytes[4:6] == b"\xab\xcd"
    assert int.from_bytes(memory.bytes[8:12], "little") == (1 << 31) | (9 << 4)
    assert memory.bytes[12:14] == b"\x00\x05"  # bit 15 of a big-endian register is its lowest
    assert int.from_bytes(memory.bytes[96:100], "little") == 77
    assert tree.limits("A") == (-(2**31), 2**31 - 1, None)
    assert tree.limits("Low")[:2] == (0, 15)
    for name, bad in (("Low", 16), ("A", 2**31), ("S", "too long a text"), ("F", float("inf")), ("A", 1.5), ("A", "1")):
        with pytest.raises(SettingError, match=name):
            tree.set(name, bad)


def test_limits_locks_and_conversions():
    memory = Memory()
    tree = features(
        '<Integer Name="W"><pValue>WR</pValue><Min>16</Min><pMax>Max</pMax><Inc>16</Inc>'
        '<pIsLocked>L</pIsLocked></Integer>'
        + register("WR", 0) + '<IntSwissKnife Name="Max"><pVariable Name="X">XR</pVariable>'
        '<Constant Name="C">640</Constant><Expression Name="R">C - X</Expression><Formula>R</Formula></IntSwissKnife>'
        + register("XR", 4) + register("L", 8)
        + '<Float Name="T"><pValue>Conv</pValue><Unit>us</Unit></Float>'
        '<Converter Name="Conv"><FormulaTo>FROM * 4</FormulaTo><FormulaFrom>TO / 4</FormulaFrom><pValue>Ticks</pValue>'
        '</Converter><Integer Name="Ticks"><pValue>TR</pValue><Min>4</Min><Max>4000</Max></Integer>'
        + register("TR", 12) + '<Command Name="Go"><pValue>GR</pValue><CommandValue>3</CommandValue></Command>'
        + register("GR", 16) + '<Enumeration Name="E"><EnumEntry Name="One"><Value>1</Value></EnumEntry>'
        '<EnumEntry Name="Two"><Value>2</Value><pIsAvailable>L</pIsAvailable></EnumEntry>'
        '<pValue>ER</pValue></Enumeration>'
        + register("ER", 20) + register("RO", 24, access="RO")
        + '<Integer Name="Hidden"><pIsImplemented>L</pIsImplemented><Value>1</Value></Integer>',
        memory,
    )  # fmt: skip
    assert tree.limits("W") == (16, 640, 16)
    tree.set("XR", 40)
    assert tree.limits("W") == (16, 600, 16)
    tree.set("T", 25.25)
    assert tree.get("TR") == 101
    assert tree.feature("T").unit == "us"
    assert tree.limits("T")[:2] == (1, 1000)
    tree.execute("Go")
    assert tree.get("GR") == 3
    assert tree.running("Go")
    tree.set("E", "One")
    assert tree.feature("E").choices == ("One",)
    with pytest.raises(SettingError, match="E must be one of One"):
        tree.set("E", "Two")
    with pytest.raises(SettingError, match="RO cannot be written"):
        tree.set("RO", 1)
    assert tree.access("Hidden") == ""
    tree.set("L", 1)
    assert tree.access("W") == "ro"
    assert tree.access("Hidden") == "rw"
    with pytest.raises(SettingError, match="W cannot be written now"):
        tree.set("W", 32)


@pytest.mark.parametrize("body", [
    '<Integer Name="A"><pValue>B</pValue></Integer><Integer Name="B"><pValue>A</pValue></Integer>',
    '<Integer Name="A"><pValue>Nobody</pValue></Integer>',
    register("A", 0, 0), register("A", 0, 9), register("A", 1 << 70), register("A", "x"), register("A", 5000),
    '<Integer Name="A"><Value>many</Value></Integer>', '<Integer Name="A"/>',
    '<SwissKnife Name="A"><Formula>1 / 0</Formula></SwissKnife>', '<SwissKnife Name="A"/>',
    register("A", 0, 4, "<LSB>5</LSB><MSB>40</MSB>", "MaskedIntReg"), register("A", 0, 3, tag="FloatReg"),
    '<Enumeration Name="A"><EnumEntry Name="One"><Value>1</Value></EnumEntry><Value>7</Value></Enumeration>',
])  # fmt: skip
def test_trees_that_make_no_sense_are_errors_of_ours(body):
    with pytest.raises(ProtocolError):
        features(body).get("A")


def exercised(xml):
    """Everything that a driver might do with a tree."""
    try:
        tree = Features(xml, Memory())
    except ProtocolError:
        return
    for name in list(tree.nodes)[:30]:
        for action in (tree.get, tree.feature, tree.execute, tree.running, lambda n: tree.set(n, 1),
                       lambda n: tree.set(n, "x"), tree.limits):  # fmt: skip
            with contextlib.suppress(AcquisitionError):
                action(name)


TEXT = CameraTwin(shape=(48, 64))._xml


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, len(TEXT) - 1), st.binary(max_size=12), st.integers(0, 40))
def test_a_damaged_description_never_escapes(place, put, cut):
    exercised(TEXT[:place] + put + TEXT[place + cut :])


words = st.sampled_from(["1", "0", "A", "B", "C", "-1", "0x10", "1e400", "nan", "A+B", "TO/FROM", "1<<A", "4", "8"])
TAGS = """
    Value pValue Min pMin Max pMax Inc Address pAddress Length pLength LSB MSB Bit Sign Endianess Formula FormulaTo
    FormulaFrom pIsLocked pIsImplemented pIndex CommandValue OnValue pValueCopy
""".split()  # fmt: skip  # noqa: SIM905
tags = st.sampled_from(TAGS)
KINDS = """
    Integer IntReg MaskedIntReg Float FloatReg StringReg Boolean Enumeration Command Converter IntConverter SwissKnife
    IntSwissKnife Register
""".split()  # fmt: skip  # noqa: SIM905
kinds = st.sampled_from(KINDS)


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(kinds, st.lists(st.tuples(tags, words), max_size=6)), min_size=1, max_size=3))
def test_a_random_description_never_escapes(nodes):
    body = ""
    for name, (kind, inside) in zip("ABC", nodes, strict=False):
        body += f'<{kind} Name="{name}">'
        body += "<AccessMode>RW</AccessMode>" + "".join(f"<{t}>{w}</{t}>" for t, w in inside)
        body += '<pVariable Name="A">B</pVariable><EnumEntry Name="e"><Value>0</Value></EnumEntry>' + f"</{kind}>"
    exercised(f"<RegisterDescription>{body}</RegisterDescription>".encode())


@given(st.text(alphabet="0123456789abAB()+-*/%&|^~<>=?:., xSINPE", max_size=60), st.booleans())
def test_a_random_formula_never_escapes(text, whole):
    try:
        value = Formula(text, whole)({"a": 3, "b": -2.5, "A": 7})
    except ProtocolError:
        return
    assert isinstance(value, int | float)
    assert np.isfinite(value)


def test_the_reference_evaluator_agrees():
    """The binding of the standard body's own GenApi over the same registers: values, limits and refusals."""
    genapi = pytest.importorskip("genicam.genapi", reason="genicam is not installed (optional peer)")
    memory = {}
    twin = CameraTwin()

    class Port(genapi.AbstractPort):
        def get_access_mode(self):
            return genapi.EAccessMode.RW

        def read(self, address, length):
            return twin._get(address, length)

        def write(self, address, value):
            memory[address] = bytes(value)
            twin._written(address, bytes(value))

    ours = Features(TEXT, type("P", (), {"read": staticmethod(twin._get), "write": staticmethod(twin._written)})())
    theirs = genapi.NodeMap()
    theirs.load_xml_from_string(TEXT.decode())
    theirs.connect(Port(), "Device")
    for name in ours.names():
        feature, node = ours.feature(name), theirs.get_node(name)
        if feature.kind == "action":
            continue
        value = node.value
        assert ours.get(name) == (pytest.approx(value) if isinstance(value, float) else value), name
        if feature.kind in ("integer", "number") and hasattr(node, "min") and feature.low is not None:
            assert feature.low == pytest.approx(node.min), name
            assert feature.high == pytest.approx(node.max), name
    theirs.get_node("Width").value = 32
    assert ours.get("Width") == 32
    ours.set("ExposureTime", 1234.0)
    assert ours.get("ExposureTime") == 1234
    with pytest.raises(genapi.GenericException):
        theirs.get_node("Width").value = 33
    with pytest.raises(SettingError):
        ours.set("Width", 33)
