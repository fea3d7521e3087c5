"""USBTMC: faults at every answer, and two foreign hosts that drive our model of an instrument."""

import sys
import time

import pytest
import usb.backend.libusb1
import usb.core
from hypothesis import given
from hypothesis import strategies as st

from acquisition import DeviceRefused, PowerMeter, RotationMount, Scpi, UsbtmcInstrument
from acquisition.errors import AcquisitionError, DeviceLost, SettingError
from acquisition.twins.backend import TwinBackend
from acquisition.twins.instrument import INSTRUMENT_FAULTS, InstrumentTwin
from acquisition.usb.instrument import DEGREE


def session(twin):
    with RotationMount.open("TMC-0001", TwinBackend(twin)) as mount:
        mount.timeout = 0.2
        assert mount.set("angle", 0.5).actual == pytest.approx(0.5, abs=1e-7)
        assert mount.get("angle") == pytest.approx(0.5, abs=1e-7)


@pytest.mark.parametrize("fault", INSTRUMENT_FAULTS)
def test_a_fault_at_any_answer_is_overcome_or_named(fault):
    plain = InstrumentTwin()
    session(plain)
    for step in range(plain.answers):
        twin = InstrumentTwin(faults={step: fault})
        start = time.monotonic()
        if fault in ("split", "in packets"):
            session(twin)
        elif fault == "no number" and step in (0, 3):
            session(twin)  # a name may be any text, and so may the answer that says that it has finished
        else:
            with pytest.raises(DeviceLost if fault == "unplug" else AcquisitionError) as caught:
                session(twin)
            assert caught.type is not AcquisitionError
        assert time.monotonic() - start < 5
        twin.plugged = True
        session(twin)  # it answers again


def test_after_a_timeout_the_same_connection_answers():
    """The read is aborted and the endpoint emptied; without that an instrument stays silent for ever."""
    twin = InstrumentTwin(faults={1: "no answer", 3: "wrong tag"})
    with UsbtmcInstrument.open("TMC-0001", TwinBackend(twin)) as instrument:
        for _ in range(2):
            with pytest.raises(AcquisitionError):
                instrument.query("ANGL?")
            assert instrument.query("ANGL?") == "0.000000"
        instrument.clear()
        assert instrument.query("*OPC?") == "1"


def test_what_the_instrument_refuses_is_an_error():
    commands = (Scpi("angle", "ANGL", "rad", scale=DEGREE, limits=False), Scpi("colour", "COLO", limits=False))
    with UsbtmcInstrument.open("TMC-0001", TwinBackend(InstrumentTwin()), commands) as instrument:
        with pytest.raises(DeviceRefused, match="out of range"):
            instrument.set("angle", 100.0)
        with pytest.raises(DeviceRefused, match="Undefined header"):
            instrument.set("colour", 1.0)
        for bad in ("", "a\nb", "ä", 3, None):
            with pytest.raises(SettingError, match="message"):
                instrument.write(bad)


def test_units_are_ours():
    twin = InstrumentTwin()
    backend = TwinBackend(twin)
    with RotationMount.open("TMC-0001", backend) as mount:
        mount.set("angle", 60 * DEGREE)
    assert twin.values["ANGL"] == pytest.approx(60)
    with PowerMeter.open("TMC-0001", backend) as meter:
        assert meter.get("power") == pytest.approx(0.25e-3)
        assert meter.get("wavelength") == pytest.approx(850e-9)
        with pytest.raises(SettingError, match="power can only be read"):
            meter.set("power", 1.0)


class Babbling(InstrumentTwin):
    """Answers with given bytes."""

    def __init__(self, answers):
        super().__init__()
        self.given = list(answers)

    def answer(self, address, length):
        return self.given.pop(0)[:length] if self.given else super().answer(address, length)


@given(st.lists(st.binary(max_size=40), max_size=6))
def test_random_answers_never_escape(answers):
    try:
        with UsbtmcInstrument.open("TMC-0001", TwinBackend(Babbling(answers))) as instrument:
            instrument.query("ANGL?")
    except AcquisitionError:
        pass


@pytest.fixture
def bus(monkeypatch):
    """Our model where foreign programs look for libusb."""
    twin = InstrumentTwin()
    backend = TwinBackend(twin)
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda *a, **k: backend)
    return twin


def test_python_usbtmc_drives_the_model(bus):
    usbtmc = pytest.importorskip("usbtmc", reason="python-usbtmc is not installed")
    instrument = usbtmc.Instrument(bus.vendor, bus.product, "TMC-0001")
    instrument.timeout = 1
    assert instrument.ask("*IDN?") == "polinfer,Instrument twin,TMC-0001,1.0"
    instrument.write("ANGL 12.5")
    assert float(instrument.ask("ANGL?")) == 12.5
    assert bus.values["ANGL"] == 12.5
    assert instrument.read_stb() == 0
    instrument.clear()
    assert instrument.ask("*OPC?") == "1"
    instrument.close()


def test_pyvisa_drives_the_model(bus):
    pytest.importorskip("pyvisa_py", reason="pyvisa-py is not installed")
    import pyvisa

    manager = pyvisa.ResourceManager("@py")
    name = f"USB0::{bus.vendor}::{bus.product}::TMC-0001::0::INSTR"
    resource = manager.open_resource(name)
    resource.timeout = 1000
    assert resource.query("*IDN?").strip() == "polinfer,Instrument twin,TMC-0001,1.0"
    resource.write("VOLT 3.25")
    assert float(resource.query("VOLT?")) == 3.25
    assert bus.values["VOLT"] == 3.25
    resource.close()
    manager.close()
    sys.stdout.flush()
