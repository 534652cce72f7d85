#!/usr/bin/env bash
# A real Slurm on this machine for a test: ./slurm_up.sh DIR starts munge, a controller and the nodes n1 and n2, whose process
# numbers stand in DIR/pids; clients need SLURM_CONF=DIR/slurm.conf.
set -eu
dir=$1 host=$(hostname -s) user=$(id -un) port=${PORT:-16817}
mkdir -p "$dir"/state "$dir"/spool "$dir"/log
chmod 755 "$dir"
export SLURM_CONF=$dir/slurm.conf
(umask 077 && head -c 128 /dev/urandom > "$dir/key")
cat > "$SLURM_CONF" << EOF
ClusterName=test
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=$port
SlurmUser=$user
SlurmdUser=$user
AuthInfo=socket=$dir/munge.socket,cred_expire=5
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool/%n
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/slurmd-%n.pid
SlurmctldLogFile=$dir/log/slurmctld.log
SlurmdLogFile=$dir/log/slurmd-%n.log
ProctrackType=proctrack/linuxproc
SchedulerParameters=batch_sched_delay=0,sched_interval=1,bf_interval=1
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=5
MinJobAge=3600
NodeName=n1 NodeHostname=$host NodeAddr=127.0.0.1 Port=$((port + 1)) CPUs=1 RealMemory=1000 State=UNKNOWN
NodeName=n2 NodeHostname=$host NodeAddr=127.0.0.1 Port=$((port + 2)) CPUs=1 RealMemory=1000 State=UNKNOWN
PartitionName=debug Nodes=ALL Default=YES MaxTime=INFINITE State=UP
EOF
munged -F --force --key-file="$dir/key" --socket="$dir/munge.socket" --pid-file="$dir/munged.pid" --seed-file="$dir/seed" \
  > "$dir/log/munged" 2>&1 &
echo $! > "$dir/pids"
for _ in $(seq 100); do [ -S "$dir/munge.socket" ] && break; sleep 0.1; done
slurmctld -D > /dev/null 2> "$dir/log/ctld.err" &
echo $! >> "$dir/pids"
for node in n1 n2; do
  slurmd -D -N "$node" > /dev/null 2> "$dir/log/$node.err" &
  echo $! >> "$dir/pids"
done
for _ in $(seq 150); do
  [ "$(sinfo -h -N -t idle 2> /dev/null | wc -l)" = 2 ] && exit
  sleep 0.2
done
cat "$dir"/log/* >&2
exit 1
