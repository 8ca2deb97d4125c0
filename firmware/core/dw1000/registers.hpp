// The registers of the DW1000 that the driver uses, one line each: file, sub-address, bytes, access (user
// manual 7.2). Fields are in the namespace of their register's name.
#pragma once

#include "firmware/core/dw1000/register.hpp"

namespace groma::dw1000::reg {

using enum Access;

// clang-format off
using DevId        = Register<0x00, 0x0000,  4, kRead>;       // 0xDECA0130
using SysCfg       = Register<0x04, 0x0000,  4, kReadWrite>;  // receiver, transmitter and interrupt line
using SysTime      = Register<0x06, 0x0000,  5, kRead>;       // the counter, in steps of 512
using TxFctrl      = Register<0x08, 0x0000,  5, kReadWrite>;  // length and format of the next frame
using TxBuffer     = Register<0x09, 0x0000, 1024, kWrite>;    // the next frame, without its check
using DxTime       = Register<0x0A, 0x0000,  5, kReadWrite>;  // when to transmit (RMARKER) or to listen
using RxFwto       = Register<0x0C, 0x0000,  2, kReadWrite>;  // frame wait time-out, in units of 65536 ticks
using SysCtrl      = Register<0x0D, 0x0000,  4, kWrite>;      // start and stop
using SysMask      = Register<0x0E, 0x0000,  4, kReadWrite>;  // which status bits raise the interrupt line
using SysStatus    = Register<0x0F, 0x0000,  5, kReadWrite>;  // what happened; writing a one clears a bit
using RxFinfo      = Register<0x10, 0x0000,  4, kRead>;       // length and preamble count of the frame
using RxBuffer     = Register<0x11, 0x0000, 1024, kRead>;     // the frame received
using RxFqual      = Register<0x12, 0x0000,  8, kRead>;       // quality of the frame
using RxTime       = Register<0x15, 0x0000, 14, kRead>;       // receive timestamp and first path
using TxTime       = Register<0x17, 0x0000,  5, kRead>;       // transmit timestamp, antenna delay added
using TxAntd       = Register<0x18, 0x0000,  2, kReadWrite>;  // added to transmit timestamps; lost in sleep
using TxPower      = Register<0x1E, 0x0000,  4, kReadWrite>;  // amplifier gains
using ChanCtrl     = Register<0x1F, 0x0000,  4, kReadWrite>;  // channel, PRF, preamble code, SFD
using AgcTune1     = Register<0x23, 0x0004,  2, kReadWrite>;  // gain control, by PRF
using AgcTune2     = Register<0x23, 0x000C,  4, kReadWrite>;  // gain control
using AgcTune3     = Register<0x23, 0x0012,  2, kReadWrite>;  // gain control
using EcCtrl       = Register<0x24, 0x0000,  4, kReadWrite>;  // external clock; PLL lock detection
using DrxTune0b    = Register<0x27, 0x0002,  2, kReadWrite>;  // receiver, by data rate and SFD
using DrxTune1a    = Register<0x27, 0x0004,  2, kReadWrite>;  // receiver, by PRF
using DrxTune1b    = Register<0x27, 0x0006,  2, kReadWrite>;  // receiver, by preamble length
using DrxTune2     = Register<0x27, 0x0008,  4, kReadWrite>;  // receiver, by acquisition chunk and PRF
using DrxSfdtoc    = Register<0x27, 0x0020,  2, kReadWrite>;  // SFD time-out, symbols
using DrxPretoc    = Register<0x27, 0x0024,  2, kReadWrite>;  // preamble time-out, acquisition chunks; 0: none
using DrxTune4h    = Register<0x27, 0x0026,  2, kReadWrite>;  // receiver, by preamble length
using DrxCarInt    = Register<0x27, 0x0028,  3, kRead>;       // carrier recovery integrator
using RxpaccNosat  = Register<0x27, 0x002C,  2, kRead>;       // preamble count, not saturated
using DrxResults   = Register<0x27, 0x0028,  6, kRead>;       // the two above, and an unused byte between
using RfRxctrlh    = Register<0x28, 0x000B,  1, kReadWrite>;  // receiver, by channel
using RfTxctrl     = Register<0x28, 0x000C,  4, kReadWrite>;  // transmitter, by channel
using RfBias       = Register<0x28, 0x0011,  1, kReadWrite>;  // bias of the temperature and supply sensors
using RfSensors    = Register<0x28, 0x0012,  1, kReadWrite>;  // bias and outputs of the sensors and their converter
using TcSarc       = Register<0x2A, 0x0000,  1, kReadWrite>;  // starts the converter
using TcSarSupply  = Register<0x2A, 0x0003,  1, kRead>;       // its last reading of the supply
using TcSarTemperature = Register<0x2A, 0x0004, 1, kRead>;    // its last reading of the temperature
using TcPgdelay    = Register<0x2A, 0x000B,  1, kReadWrite>;  // pulse width, by channel
using FsPllcfg     = Register<0x2B, 0x0007,  4, kReadWrite>;  // synthesizer, by channel
using FsPlltune    = Register<0x2B, 0x000B,  1, kReadWrite>;  // synthesizer, by channel
using FsXtalt      = Register<0x2B, 0x000E,  1, kReadWrite>;  // crystal trim
using AonWcfg      = Register<0x2C, 0x0000,  2, kReadWrite>;  // what the chip restores when it wakes
using AonCtrl      = Register<0x2C, 0x0002,  1, kReadWrite>;  // copies the two others to the always-on memory
using AonCfg0      = Register<0x2C, 0x0006,  1, kReadWrite>;  // sleep and wake-up (its low byte)
using OtpAddr      = Register<0x2D, 0x0004,  2, kReadWrite>;  // one-time programmable word to read
using OtpCtrl      = Register<0x2D, 0x0006,  2, kReadWrite>;  // read it, load the LDE microcode
using OtpRdat      = Register<0x2D, 0x000A,  4, kRead>;       // the word read
using OtpSf        = Register<0x2D, 0x0012,  1, kReadWrite>;  // special functions: LDO tune
using LdeCfg1      = Register<0x2E, 0x0806,  1, kReadWrite>;  // leading edge: noise threshold
using LdePpindx    = Register<0x2E, 0x1000,  2, kRead>;       // sample of the strongest path
using LdeRxantd    = Register<0x2E, 0x1804,  2, kReadWrite>;  // subtracted from the receive timestamp
using LdeCfg2      = Register<0x2E, 0x1806,  2, kReadWrite>;  // leading edge, by PRF
using LdeRepc      = Register<0x2E, 0x2804,  2, kReadWrite>;  // leading edge, by preamble code
using PmscCtrl0    = Register<0x36, 0x0000,  2, kReadWrite>;  // clocks (its low half)
using PmscClock    = Register<0x36, 0x0000,  1, kReadWrite>;  // clocks of system, receiver, transmitter
using PmscReset    = Register<0x36, 0x0003,  1, kReadWrite>;  // soft reset: 0xF0 none, 0xE0 receiver
using PmscCtrl1    = Register<0x36, 0x0004,  4, kRead>;       // more clocks
// clang-format on

namespace sys_cfg {
inline constexpr Field<SysCfg, 9> kInterruptHigh{};
inline constexpr Field<SysCfg, 12> kSingleBuffer{};      // DIS_DRXB
inline constexpr Field<SysCfg, 18> kConstantPower{};     // DIS_STXP: no boost for short frames
inline constexpr Field<SysCfg, 28> kFrameWaitTimeout{};  // RXWTOE
}  // namespace sys_cfg

namespace tx_fctrl {
inline constexpr Field<TxFctrl, 0, 10> kLength{};   // with frame check
inline constexpr Field<TxFctrl, 13, 2> kBitRate{};  // 2: 6.8 Mbit/s
inline constexpr Field<TxFctrl, 15> kRanging{};
inline constexpr Field<TxFctrl, 16, 2> kPrf{};       // 2: 64 MHz
inline constexpr Field<TxFctrl, 18, 4> kPreamble{};  // TXPSR and PE
}  // namespace tx_fctrl

namespace sys_ctrl {
inline constexpr Field<SysCtrl, 1> kTransmit{};         // TXSTRT
inline constexpr Field<SysCtrl, 2> kDelayedTransmit{};  // TXDLYS
inline constexpr Field<SysCtrl, 6> kOff{};              // TRXOFF
inline constexpr Field<SysCtrl, 8> kReceive{};          // RXENAB
inline constexpr Field<SysCtrl, 9> kDelayedReceive{};   // RXDLYE
}  // namespace sys_ctrl

namespace sys_status {
inline constexpr Field<SysStatus, 0> kInterrupt{};         // IRQS: an unmasked bit is set
inline constexpr Field<SysStatus, 1> kPllLocked{};         // CPLOCK
inline constexpr Field<SysStatus, 7> kTransmitted{};       // TXFRS
inline constexpr Field<SysStatus, 10> kTimestamped{};      // LDEDONE
inline constexpr Field<SysStatus, 12> kHeaderError{};      // RXPHE
inline constexpr Field<SysStatus, 14> kReceived{};         // RXFCG
inline constexpr Field<SysStatus, 15> kCheckError{};       // RXFCE
inline constexpr Field<SysStatus, 16> kSyncLoss{};         // RXRFSL: Reed-Solomon gave up
inline constexpr Field<SysStatus, 17> kFrameTimeout{};     // RXRFTO
inline constexpr Field<SysStatus, 18> kTimestampError{};   // LDEERR
inline constexpr Field<SysStatus, 21> kPreambleTimeout{};  // RXPTO
inline constexpr Field<SysStatus, 24> kRfPllLosing{};      // RFPLL_LL
inline constexpr Field<SysStatus, 25> kClockPllLosing{};   // CLKPLL_LL
inline constexpr Field<SysStatus, 26> kSfdTimeout{};       // RXSFDTO
inline constexpr Field<SysStatus, 27> kHalfPeriod{};       // HPDWARN: the delayed start is over 8.6 s ahead
inline constexpr Field<SysStatus, 34> kPowerUpError{};     // TXPUTE: the delayed start came before power-up
}  // namespace sys_status

namespace rx_finfo {
inline constexpr Field<RxFinfo, 0, 10> kLength{};          // with frame check
inline constexpr Field<RxFinfo, 20, 12> kPreambleCount{};  // RXPACC
}  // namespace rx_finfo

namespace rx_fqual {
inline constexpr Field<RxFqual, 0, 16> kNoise{};          // STD_NOISE
inline constexpr Field<RxFqual, 16, 16> kAmplitude2{};    // FP_AMPL2
inline constexpr Field<RxFqual, 32, 16> kAmplitude3{};    // FP_AMPL3
inline constexpr Field<RxFqual, 48, 16> kChannelPower{};  // CIR_PWR
}  // namespace rx_fqual

namespace rx_time {
inline constexpr Field<RxTime, 0, 40> kTimestamp{};
inline constexpr Field<RxTime, 40, 16> kFirstPath{};   // FP_INDEX, 1/64 samples
inline constexpr Field<RxTime, 56, 16> kAmplitude1{};  // FP_AMPL1
}  // namespace rx_time

namespace tx_time {
inline constexpr Field<TxTime, 0, 40> kTimestamp{};
}  // namespace tx_time

namespace ec_ctrl {
inline constexpr Field<EcCtrl, 2> kLockDetect{};  // PLLLDT: without it the lock flags are not reliable
}  // namespace ec_ctrl

namespace drx_car_int {
inline constexpr Field<DrxCarInt, 0, 21> kIntegral{};  // signed
}  // namespace drx_car_int

namespace drx_results {
inline constexpr Field<DrxResults, 0, 21> kIntegral{};  // signed
inline constexpr Field<DrxResults, 32, 16> kUnsaturatedCount{};
}  // namespace drx_results

namespace aon_ctrl {
inline constexpr Field<AonCtrl, 1> kSave{};    // SAVE
inline constexpr Field<AonCtrl, 2> kUpload{};  // UPL_CFG
}  // namespace aon_ctrl

namespace otp_ctrl {
inline constexpr Field<OtpCtrl, 0> kReadEnable{};      // OTPRDEN
inline constexpr Field<OtpCtrl, 1> kRead{};            // OTPREAD
inline constexpr Field<OtpCtrl, 15> kLoadMicrocode{};  // LDELOAD
}  // namespace otp_ctrl

namespace fs_xtalt {
inline constexpr Field<FsXtalt, 0, 5> kTrim{};
inline constexpr Field<FsXtalt, 5, 3> kFixed{};  // always 3
}  // namespace fs_xtalt

namespace pmsc_ctrl1 {
inline constexpr Field<PmscCtrl1, 17> kLeadingEdge{};  // LDERUNE: detects it in each received frame
}  // namespace pmsc_ctrl1

}  // namespace groma::dw1000::reg
