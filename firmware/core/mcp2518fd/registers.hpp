// The registers of the MCP2518FD that the driver uses (data sheet DS20006027, section 3), and the objects in
// its message RAM (family reference manual DS20005678, section 3.3).
#pragma once

#include "firmware/core/mcp2518fd/register.hpp"

namespace groma::mcp2518fd {

// The first four bits of a transfer; twelve address bits follow.
enum class Instruction : std::uint8_t { kReset = 0x0, kWrite = 0x2, kRead = 0x3 };

enum class Mode : std::uint8_t {
  kNormalFd = 0,
  kConfiguration = 4,
  kNormalClassic = 6,
};

// Transmit FIFO and receive FIFO are the first two of 31.
inline constexpr unsigned kTransmitFifo = 1;
inline constexpr unsigned kReceiveFifo = 2;

namespace reg {

// clang-format off
using Con          = Register<0x000>;  // CiCON: modes
using Nbtcfg       = Register<0x004>;  // CiNBTCFG: nominal bit time
using Dbtcfg       = Register<0x008>;  // CiDBTCFG: data bit time
using Tdc          = Register<0x00C>;  // CiTDC: transmitter delay compensation
using Int          = Register<0x01C>;  // CiINT: interrupt flags and enables
using Trec         = Register<0x034>;  // CiTREC: error counters and states
using Bdiag1       = Register<0x03C>;  // CiBDIAG1: kinds of errors since they were cleared
using TransmitCon  = Register<0x050 + 12 * kTransmitFifo>;  // CiFIFOCON1: control
using TransmitSta  = Register<0x054 + 12 * kTransmitFifo>;  // CiFIFOSTA1: status
using TransmitUa   = Register<0x058 + 12 * kTransmitFifo>;  // CiFIFOUA1: next object for the processor
using ReceiveCon   = Register<0x050 + 12 * kReceiveFifo>;
using ReceiveSta   = Register<0x054 + 12 * kReceiveFifo>;
using ReceiveUa    = Register<0x058 + 12 * kReceiveFifo>;
using Fltcon0      = Register<0x1D0>;  // CiFLTCON0: filters 0 to 3
using Fltobj0      = Register<0x1F0>;  // CiFLTOBJ0: id for filter 0
using Mask0        = Register<0x1F4>;  // CiMASK0: the bits of it that are compared
using Osc          = Register<0xE00>;  // clock
using Ecccon       = Register<0xE0C>;  // error correction of the message RAM
// clang-format on

namespace con {
inline constexpr Field<Con, 24, 3> kRequest{};      // REQOP
inline constexpr Field<Con, 27> kAbort{};           // ABAT: abort all transmissions
inline constexpr Field<Con, 21, 3> kMode{};         // OPMOD
inline constexpr Field<Con, 9, 2> kWakeUpFilter{};  // WFT
inline constexpr Field<Con, 8> kWakeUpFiltered{};   // WAKFIL
inline constexpr Field<Con, 6> kNoException{};      // PXEDIS: a reserved bit is a form error
inline constexpr Field<Con, 5> kIsoCrc{};           // ISOCRCEN
}  // namespace con

namespace nbtcfg {
inline constexpr Field<Nbtcfg, 24, 8> kPrescaler{};  // each field of this register holds its value less one
inline constexpr Field<Nbtcfg, 16, 8> kSegment1{};
inline constexpr Field<Nbtcfg, 8, 7> kSegment2{};
inline constexpr Field<Nbtcfg, 0, 7> kJumpWidth{};
}  // namespace nbtcfg

namespace dbtcfg {
inline constexpr Field<Dbtcfg, 24, 8> kPrescaler{};  // each field of this register holds its value less one
inline constexpr Field<Dbtcfg, 16, 5> kSegment1{};
inline constexpr Field<Dbtcfg, 8, 4> kSegment2{};
inline constexpr Field<Dbtcfg, 0, 4> kJumpWidth{};
}  // namespace dbtcfg

namespace tdc {
inline constexpr Field<Tdc, 17> kAutomatic{};  // TDCMOD: 2, measure the delay
inline constexpr Field<Tdc, 8, 7> kOffset{};   // TDCO
}  // namespace tdc

namespace interrupt {
inline constexpr Field<Int, 1> kReceived{};        // RXIF
inline constexpr Field<Int, 3> kModeChanged{};     // MODIF
inline constexpr Field<Int, 8> kRamError{};        // ECCIF
inline constexpr Field<Int, 11> kOverrun{};        // RXOVIF
inline constexpr Field<Int, 12> kSystemError{};    // SERRIF
inline constexpr Field<Int, 13> kErrorState{};     // CERRIF
inline constexpr Field<Int, 0> kTransmit{};        // TXIF
inline constexpr Field<Int, 16> kOnTransmit{};     // TXIE
inline constexpr Field<Int, 17> kOnReceived{};     // RXIE
inline constexpr Field<Int, 19> kOnModeChanged{};  // MODIE
inline constexpr Field<Int, 24> kOnRamError{};     // ECCIE
inline constexpr Field<Int, 27> kOnOverrun{};      // RXOVIE
inline constexpr Field<Int, 28> kOnSystemError{};  // SERRIE
inline constexpr Field<Int, 29> kOnErrorState{};   // CERRIE
inline constexpr Field<Int, 16, 16> kEnables{};
}  // namespace interrupt

namespace trec {
inline constexpr Field<Trec, 0, 8> kReceiveErrors{};
inline constexpr Field<Trec, 8, 8> kTransmitErrors{};
inline constexpr Field<Trec, 21> kBusOff{};  // TXBO
}  // namespace trec

namespace bdiag1 {
inline constexpr Field<Bdiag1, 23> kWasBusOff{};  // TXBOERR
}  // namespace bdiag1

namespace transmit_con {
inline constexpr Field<TransmitCon, 29, 3> kPayloadSize{};  // PLSIZE
inline constexpr Field<TransmitCon, 24, 5> kDepth{};        // FSIZE, less one
inline constexpr Field<TransmitCon, 21, 2> kAttempts{};     // TXAT: 3: no limit
inline constexpr Field<TransmitCon, 9> kRequest{};          // TXREQ
inline constexpr Field<TransmitCon, 8> kAdvance{};          // UINC
inline constexpr Field<TransmitCon, 7> kTransmit{};         // TXEN: a FIFO to transmit from
inline constexpr Field<TransmitCon, 1> kOnHalfEmpty{};      // TFHRFHIE
}  // namespace transmit_con

namespace transmit_sta {
inline constexpr Field<TransmitSta, 1> kHalfEmpty{};  // TFHRFHIF
inline constexpr Field<TransmitSta, 2> kEmpty{};      // TFERFFIF
}  // namespace transmit_sta

namespace receive_con {
inline constexpr Field<ReceiveCon, 29, 3> kPayloadSize{};  // PLSIZE
inline constexpr Field<ReceiveCon, 24, 5> kDepth{};        // FSIZE, less one
inline constexpr Field<ReceiveCon, 8> kAdvance{};          // UINC
inline constexpr Field<ReceiveCon, 3> kOnOverrun{};        // RXOVIE
inline constexpr Field<ReceiveCon, 0> kOnNotEmpty{};       // TFNRFNIE
}  // namespace receive_con

namespace receive_sta {
inline constexpr Field<ReceiveSta, 0> kNotEmpty{};  // TFNRFNIF
inline constexpr Field<ReceiveSta, 3> kOverrun{};   // RXOVIF
}  // namespace receive_sta

namespace fltcon0 {
inline constexpr Field<Fltcon0, 7> kEnable{};   // FLTEN0
inline constexpr Field<Fltcon0, 0, 5> kFifo{};  // F0BP
}  // namespace fltcon0

namespace fltobj0 {
inline constexpr Field<Fltobj0, 30> kExtended{};   // EXIDE
inline constexpr Field<Fltobj0, 11, 18> kLowId{};  // EID
inline constexpr Field<Fltobj0, 0, 11> kHighId{};  // SID
}  // namespace fltobj0

namespace mask0 {
inline constexpr Field<Mask0, 30> kExtended{};   // MIDE
inline constexpr Field<Mask0, 11, 18> kLowId{};  // MEID
inline constexpr Field<Mask0, 0, 11> kHighId{};  // MSID
}  // namespace mask0

namespace osc {
inline constexpr Field<Osc, 10> kReady{};     // OSCRDY
inline constexpr Field<Osc, 5, 2> kOutput{};  // CLKODIV: 3: a tenth, as after a reset
inline constexpr Field<Osc, 3> kLowPower{};   // LPMEN: not in the MCP2517FD
}  // namespace osc

namespace ecccon {
inline constexpr Field<Ecccon, 0> kEnable{};    // ECCEN
inline constexpr Field<Ecccon, 1> kOnSingle{};  // SECIE
inline constexpr Field<Ecccon, 2> kOnDouble{};  // DEDIE
}  // namespace ecccon

}  // namespace reg

// The first two words of an object in the message RAM, equal for transmission and reception. The payload
// follows.
struct ObjectId : Register<0x000> {};
struct ObjectControl : Register<0x004> {};

namespace object {
inline constexpr Field<ObjectId, 0, 11> kHighId{};
inline constexpr Field<ObjectId, 11, 18> kLowId{};
inline constexpr Field<ObjectControl, 0, 4> kLength{};   // DLC
inline constexpr Field<ObjectControl, 4> kExtended{};    // IDE
inline constexpr Field<ObjectControl, 5> kRemote{};      // RTR
inline constexpr Field<ObjectControl, 6> kSwitchRate{};  // BRS
inline constexpr Field<ObjectControl, 7> kFd{};          // FDF
}  // namespace object

inline constexpr std::uint16_t kRamBegin = 0x400;
inline constexpr std::uint16_t kRamBytes = 2048;

}  // namespace groma::mcp2518fd
